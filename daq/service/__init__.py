"""The service: REST API, live streams and the page; it parses, calls and formats."""

#: After which a diagnosis that nobody gave another limit seeks no further explanation.
LONGEST_SEARCH_S = 600.0
