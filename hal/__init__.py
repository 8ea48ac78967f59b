"""The hardware behind two contracts, `Arm` and `Camera`, and the safety that lives below every producer."""
