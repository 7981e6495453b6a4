"""Labels and maps against ground truth."""
