"""CRTP, the protocol of Bitcraze's Crazyflie: packets of its parameters, and the link that carries them."""
