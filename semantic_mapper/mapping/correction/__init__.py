"""Maps that follow corrected poses."""
