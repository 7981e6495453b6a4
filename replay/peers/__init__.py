"""Other mappers and odometries, measured on one log with ours."""
