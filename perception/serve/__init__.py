"""The HTTP server of a map: JSON, binary points, a web page. It only converts messages of perception.query."""
