"""The HTTP server of a map: JSON and binary points. It only converts messages of perception.query."""
