"""Recording: MCAP logs, and videos rendered from them."""
