"""The artifact store: objects by content, written whole or not at all, on this disk or in S3."""
