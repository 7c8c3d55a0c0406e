"""What a written program does to the block, and whether it may be used."""
