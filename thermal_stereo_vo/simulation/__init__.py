"""A known world seen by simulated cameras."""
