"""Data, losses, the training loop and finetuning."""
