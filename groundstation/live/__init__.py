"""While it flies: a window over the last ticks, looks at it in a process of their own, and what has changed."""
