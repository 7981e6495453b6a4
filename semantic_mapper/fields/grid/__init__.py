"""A radiance field on a dense grid, which two cores can fit: the base of fields of one scene."""
