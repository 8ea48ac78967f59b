"""Untrained networks with detections, and pictures, for tests of the detector."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from models.detector.weights import disable_ultralytics_network, new_network

disable_ultralytics_network()


def randomise_head(network, seed=0):
    """Return `network` with a few dozen detections in any image, each with a mask."""
    _settle(network)
    generator = torch.Generator().manual_seed(seed)
    head = network.model[-1]
    with torch.no_grad():
        for branch in [*head.cv2, *head.cv3, *getattr(head, "cv4", [])]:
            weight = 0.3 * torch.randn(branch[-1].weight.shape, generator=generator)
            branch[-1].weight.copy_(weight - weight.mean(dim=1, keepdim=True))
        for branch in head.cv3:  # confidences near 1 would be ordered by the last bit
            branch[-1].weight.mul_(0.5)
            branch[-1].bias.fill_(-2.5)
    return network.eval()


def _settle(network):
    """Set the batch norms to the statistics of their inputs: otherwise an untrained network's signals vanish."""
    norms = [module for module in network.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.momentum = 1.0
    image = torch.from_numpy(np.stack([picture(256, 320, seed) for seed in range(2)])).permute(0, 3, 1, 2) / 255.0
    with torch.no_grad():
        network.train()(image)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum


def segmenting(n_classes=3, seed=0):
    """Return an untrained YOLOv8n-seg with detections."""
    torch.manual_seed(seed)
    return randomise_head(new_network(n_classes), seed)


def detecting(n_classes=3, seed=0):
    """Return an untrained YOLOv8n with detections."""
    from ultralytics.nn.tasks import DetectionModel

    torch.manual_seed(seed)
    return randomise_head(DetectionModel("yolov8n.yaml", ch=3, nc=n_classes, verbose=False), seed)


def save_checkpoint(path, network, names, task):
    """Write `network` in ultralytics' .pt format."""
    network.names, network.task = dict(enumerate(names)), task
    torch.save({"model": network, "ema": None, "train_args": {"task": task}, "version": "8.4.0"}, path)


def picture(height, width, seed=0):
    """Return an image (height, width, 3) uint8 of coloured blobs."""
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 24 + 1, width // 24 + 1, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
