(pass tiny: _ball_)
(zero: G54, with G92 and tool length G43.1 as they were when it was set)
(start: homed, from anywhere: up to machine Z-1, across, down; ends up there)
G21G90G94G17G54
G53G0Z-1
M3S12000
G4P4
G0X0Y-0.5
Z5
Z1
G1Z0.1F250
X2Z-0.004
X2.5Z-0.12346F612.55
Y0Z-0.15
X-1Z-1.99999
G0Z5
G53G0Z-1
M5
M2
