"""The operator's page: a client of the service like any other, with a browser in front."""
