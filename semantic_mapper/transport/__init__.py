"""Messages between processes: one codec for wire and log, ZeroMQ sockets, one table of topics."""
