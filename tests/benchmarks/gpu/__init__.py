"""What a card does: speed, agreement with the processor, accuracy and a peer, measured on the card that is there."""
