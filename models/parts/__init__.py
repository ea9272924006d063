"""Parts that somebody brings along: two mesh files, and what a simulation needs to know of them."""
