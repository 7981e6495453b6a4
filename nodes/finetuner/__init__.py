"""The finetuner node: labelled keyframes in, better weights out."""
