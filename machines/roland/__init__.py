"""Roland MDX-class mills: RML-1, the serial link with hardware handshake, and the MDX-40A's own USB link."""
