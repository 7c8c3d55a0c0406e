"""What is moved and milled around the passes of the lens: a trace in the air, the stock's top, the lens cut out."""
