"""Fields that are fitted to one scene, on a dense grid."""
