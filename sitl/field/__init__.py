"""Vehicle and tuning together: gains tuned, tried and kept or taken back in the field."""
