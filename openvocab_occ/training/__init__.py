"""Training of occupancy networks, with and without long-term memory."""
