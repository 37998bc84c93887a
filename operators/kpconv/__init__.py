"""KPConv (Thomas et al. 2019) on two CPU cores: input pyramids, KPFCNN, training, and inference at the lidar's rate.

classifier = load_classifier(Path("weights.safetensors"))  # operators.kpconv.classifier
classified = classifier.classify(points_lidar, base_from_lidar)

Nothing is imported here, so that what needs no torch does not load it.
"""

import os

# Torch's threads would else wait for each other in busy loops: with another process on the same cores a product of a
# millisecond then takes a hundred. Read when torch is loaded, so it stands before that.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
