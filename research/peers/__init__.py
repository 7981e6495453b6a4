"""Fields that S-Ray is measured against; no robot uses them, and none is imported before it is named."""
