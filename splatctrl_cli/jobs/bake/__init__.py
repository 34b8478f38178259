"""Distance fields baked on a grid."""
