"""What the bridges to other tools share: listening to a launch, following its map, packing both."""
