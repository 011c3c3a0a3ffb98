"""A functional mock-up unit (FMI 2 or 3, co-simulation) as a plant, in a process of its own."""
