"""What flows where: the steps, their configuration, and how one feeds the next."""
