"""One Drake LeafSystem per file, each a thin shell over a law that can be called without a diagram."""
