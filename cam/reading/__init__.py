"""Programs of any control back to moves; shares nothing with `cam.posts`."""
