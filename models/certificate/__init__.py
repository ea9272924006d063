"""What a movement primitive can command at all, whatever its policy does: computed, written down, and checked."""
