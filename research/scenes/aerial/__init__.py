"""Towns seen from a drone: the suite AERIAL."""
