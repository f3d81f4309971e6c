"""Text queries on instances: the encoder protocol and encoders, instance descriptions, ranking for a prompt."""
