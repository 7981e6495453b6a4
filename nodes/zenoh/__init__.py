"""The bridge to Zenoh."""
