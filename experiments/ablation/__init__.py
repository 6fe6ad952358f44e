"""What leaving out costs and gains, group by group."""
