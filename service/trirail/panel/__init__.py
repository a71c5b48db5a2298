"""Operator's web page. Its server is an ordinary client of the service, and browsers are the user interface."""
