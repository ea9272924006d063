"""What several systems are made of, and what is no LeafSystem itself."""
