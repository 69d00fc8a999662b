"""Robots simulated by MuJoCo: the ant among walls and blocks, and the cheetah that must run backward."""
