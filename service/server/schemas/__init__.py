"""What requests and answers are made of: the models that answer, and that the OpenAPI document describes."""
