"""From raw counts to corrected linear counts and an 8-bit view; one object per camera."""
