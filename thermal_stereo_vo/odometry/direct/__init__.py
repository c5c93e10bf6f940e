"""Direct odometry: brightness itself is what is compared, no features and no matches."""
