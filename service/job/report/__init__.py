"""The setup sheet, its sentences, the solid to look at; `figures` has the pictures."""
