"""Words for instances: encoders behind one protocol, descriptions, and the ranking of a prompt's answers."""
