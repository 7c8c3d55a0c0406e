"""`causticmill stream`: one program on one mill, watched from this terminal."""
