"""The paper's first experiment: a robot that drives, labels what it saw, learns, and drives better, round after round.

`schedule` says which sessions there are and with which seeds, `variants` makes the graph of each, `figures` draws,
`tally` counts, `report` writes it all down. What launches and reads recordings ends in `_command`.
"""
