"""The bench's page: a web server that is a client of the bench, as the command line is."""
