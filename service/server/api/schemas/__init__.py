"""What requests and answers look like in the OpenAPI document."""
