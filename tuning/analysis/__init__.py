"""The closed loop of a gain set: transfers, margins, certificate, predicted doublets."""
