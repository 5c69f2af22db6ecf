"""What is measured: metrics, speed and memory."""
