"""What a robot sees, knows and intends, drawn in Rerun: arrays in, entities out."""
