"""Small networks of the usual kinds for N×3×16×16, in torch."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

LABELS = ["red", "green", "blue", "none"]


class ResNet(nn.Module):
    """Residual blocks with BatchNorm, additions and ReLUs in place, pools, and a channel shuffle between."""

    def __init__(self):
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(3, 8, 3, 2, 1, bias=False), nn.BatchNorm2d(8), nn.ReLU(True))
        self.block = nn.Sequential(nn.Conv2d(8, 8, 3, 1, 1), nn.BatchNorm2d(8), nn.ReLU(True), nn.Conv2d(8, 8, 1))
        self.gate = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Conv2d(8, 8, 1), nn.Hardsigmoid(inplace=True))
        self.head = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Dropout(0.2), nn.Linear(16, 4))

    def forward(self, x: Tensor) -> Tensor:
        x = F.max_pool2d(self.stem(x), 3, 2, 1)
        y = self.block(x)
        y += x
        left, right = F.relu(y, inplace=True).chunk(2, 1)
        n, c, h, w = left.shape
        shuffled = torch.cat([left, right], 1).view(n, 2, c, h, w).transpose(1, 2).reshape(n, 2 * c, h, w)
        return self.head(torch.cat([shuffled * self.gate(shuffled), y], 1))


class ViT(nn.Module):
    """Patches, a class token, and two blocks of attention, one of them written out as timm does without the kernel."""

    def __init__(self, width: int = 16, heads: int = 2):
        super().__init__()
        self.heads = heads
        self.patch = nn.Conv2d(3, width, 4, 4)
        self.token = nn.Parameter(torch.zeros(1, 1, width))
        self.place = nn.Parameter(torch.zeros(1, 17, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width, eps=1e-6) for _ in range(5))
        self.qkv = nn.ModuleList(nn.Linear(width, 3 * width) for _ in range(2))
        self.mlp = nn.ModuleList(
            nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(kind), nn.Linear(2 * width, width))
            for kind in ("none", "tanh")
        )
        self.head = nn.Linear(width, 4)

    def forward(self, x: Tensor) -> Tensor:
        x = self.patch(x).flatten(2).transpose(1, 2)
        x = torch.cat([self.token.expand(x.shape[0], -1, -1), x], 1) + self.place
        for block, (qkv, mlp) in enumerate(zip(self.qkv, self.mlp, strict=True)):
            n, length, width = x.shape
            projected = qkv(self.norms[2 * block](x)).reshape(n, length, 3, self.heads, width // self.heads)
            q, k, v = projected.permute(2, 0, 3, 1, 4).unbind(0)
            if block:
                y = (q * q.shape[-1] ** -0.5 @ k.transpose(-2, -1)).softmax(-1) @ v
            else:
                y = F.scaled_dot_product_attention(q, k, v)
            x = x + y.transpose(1, 2).reshape(n, length, width)
            x = x + mlp(self.norms[2 * block + 1](x))
        return self.head(self.norms[4](x)[:, 0])


class ConvNeXt(nn.Module):
    """A depthwise block with channels last and a layer scale, then Swin's windows: rolled, cut, masked, joined."""

    def __init__(self, width: int = 8):
        super().__init__()
        self.stem = nn.Conv2d(3, width, 2, 2)
        self.depth = nn.Conv2d(width, width, 7, padding=3, groups=width)
        self.norm = nn.LayerNorm(width)
        self.wide, self.narrow = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.scale = nn.Parameter(torch.full((width,), 0.5))
        self.register_buffer("mask", torch.eye(16).bool())
        self.head = nn.Linear(width, 4)

    def forward(self, x: Tensor) -> Tensor:
        x = self.stem(x)
        y = self.norm(self.depth(x).permute(0, 2, 3, 1))
        y = x.permute(0, 2, 3, 1) + self.scale * self.narrow(F.gelu(self.wide(y)))
        n, h, w, c = y.shape
        y = (
            torch.roll(y, (-1, -1), (1, 2))
            .view(n, h // 4, 4, w // 4, 4, c)
            .permute(0, 1, 3, 2, 4, 5)
            .reshape(-1, 16, c)
        )
        weights = (y @ y.transpose(1, 2)).masked_fill(self.mask, float("-inf")).softmax(-1)
        y = (weights @ y).view(n, h // 4, w // 4, 4, 4, c).permute(0, 1, 3, 2, 4, 5).reshape(n, h, w, c)
        return self.head(F.adaptive_avg_pool2d(y.permute(0, 3, 1, 2), 1).flatten(1))


def seeded(network: nn.Module) -> nn.Module:
    """In evaluation mode, with weights and statistics that are the same every time, and are not 0 or 1."""
    generator = torch.Generator().manual_seed(1)
    for tensor in (*network.parameters(), *(b for name, b in network.named_buffers() if "running" in name)):
        noise = torch.randn(tensor.shape, generator=generator)
        tensor.data = 1 + 0.1 * noise if tensor.dim() < 2 else noise / tensor[0].numel() ** 0.5
    return network.eval()
