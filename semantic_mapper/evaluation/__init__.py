"""Metrics of labels, maps and confidences, and the pictures that show them. Stands on the ground floor only."""
