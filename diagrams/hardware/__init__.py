"""Hardware stations: driver interface, drivers, clocks and safety monitor."""
