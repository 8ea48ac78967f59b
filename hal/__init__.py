"""Hardware layer: two contracts, `Arm` and `Camera`, and the safety functions below every client."""
