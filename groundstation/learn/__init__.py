"""The network: its training data, training and ablation."""
