"""`python -m perception.cli`."""

from perception.cli import run

run()
