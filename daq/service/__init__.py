"""The service: REST API, live streams and the page; it parses, calls and formats."""
