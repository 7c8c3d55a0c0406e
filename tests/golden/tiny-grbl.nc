(pass tiny: _ball_)
(zero: G54, with G92 and tool length G43.1 as they were when it was set)
(start: with the tool over the block, or not above Z5, where it goes first)
G21G90G94G17G54
G0Z5
M3S12000
G4P4
G0X0Y-0.5Z5
Z1
G1Z0.1F250
X2Z-0.004
X2.5Z-0.12346F612.55
Y0Z-0.15
X-1Z-1.99999
G0Z5
M5
M2
