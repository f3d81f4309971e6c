"""From the instances of a Gaussian map to the points of clouds and meshes, and out into other programs'
files.
"""
