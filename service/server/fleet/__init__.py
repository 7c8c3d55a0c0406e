"""The mills of the shop: their agents, and runs on them."""
