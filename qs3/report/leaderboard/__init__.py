"""A method of one's own as a row of the leaderboard."""
