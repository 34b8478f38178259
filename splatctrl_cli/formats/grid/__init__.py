"""The formats of a baked distance grid."""
