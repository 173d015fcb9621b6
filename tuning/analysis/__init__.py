"""The closed loop of a gain set: frequency responses, margins, certificate, predicted doublets."""
