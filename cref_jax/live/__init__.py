"""A page in the browser on which people drive the whole robot."""
