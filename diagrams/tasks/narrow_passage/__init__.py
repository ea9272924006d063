"""The task NarrowPassage."""
