"""The routes of the REST interface, a file for each resource."""
