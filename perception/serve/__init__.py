"""A map over HTTP: JSON, binary points and a page. Only messages are converted here; perception.query thinks."""
