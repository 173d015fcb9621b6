"""Readers that turn flight logs into `tuning.experiment.Experiment`."""
