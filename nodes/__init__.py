"""Thin processes round the library: camera, mapper and recorder nodes, their launcher, and the command line."""
