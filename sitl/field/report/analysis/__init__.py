"""What a report computes from a log: phases, spectra, step responses, predicted motion, filters."""
