"""Operator's page: a client of the service like any other, with a browser as its front end."""
