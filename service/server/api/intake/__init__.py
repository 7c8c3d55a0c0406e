"""Receives and checks uploads, pictures and photographs."""
