"""Pictures without poses into a posed log: structure from motion over a film or a folder of pictures."""
