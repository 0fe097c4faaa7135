"""Before the drone starts and before the computing starts: plan the flight that is needed, check the one flown."""
