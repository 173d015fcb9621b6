"""MAVLink 2 wire format, for both ends of a link: frames, signing, sockets, mode numbers, parameter files."""
