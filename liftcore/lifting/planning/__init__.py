"""What a lift will take, before it is made: splats, views, channels, memory; the work is sized from it."""
