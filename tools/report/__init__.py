"""`guiderail report`: what runs and studies came to, as one page."""
