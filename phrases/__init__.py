"""What people are told, in a form that every language can be made of; below all other packages."""
