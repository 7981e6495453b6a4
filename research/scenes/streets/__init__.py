"""Streets seen from a car: drives laid out as KITTI-360 is, and the suite STREETS."""
