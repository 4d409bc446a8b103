"""Training throughput of the same network, losses and optimiser in PyTorch on the CPU.

The counterpart of `cargo bench -p tsda-trainer --bench throughput`: same shapes, same frozen layers
(backbone before stride 16; every batch norm of the backbone is folded into its convolution, as the
Rust trainer does), same dropout, AdamW with two learning rates, running average of the weights. The
network is written here from the specification; it shares no code with the Rust crates.

    pip install torch
    python3 scripts/torch_throughput.py [--preset nano|tomp50] [--threads N] [--channels-last]

Prints one line of JSON with the fields of the Rust benchmark. Variants that can make PyTorch faster
(--channels-last, --fused for the fused AdamW) are options: compare with the best of them.
"""
import argparse
import json
import math
import resource
import time

import torch
import torch.nn as nn
import torch.nn.functional as F

PRESETS = {
    "nano": dict(crop=160, batch=8, steps=30, width=128, heads=4, ff=256, enc=2, dec=2, hidden=32),
    "tomp50": dict(crop=144, batch=4, steps=5, width=256, heads=8, ff=2048, enc=6, dec=6, hidden=64),
}


class FoldedConv(nn.Module):
    """Convolution with a batch norm of fixed statistics folded in; `same`: TensorFlow's padding."""

    def __init__(self, inp, out, kernel, stride=1, groups=1, same=False, act=None, eps=1e-5):
        super().__init__()
        self.conv = nn.Conv2d(inp, out, kernel, stride, 0, groups=groups, bias=False)
        self.gamma, self.beta = nn.Parameter(torch.ones(out)), nn.Parameter(torch.zeros(out))
        self.register_buffer("mean", torch.zeros(out))
        self.register_buffer("var", torch.ones(out))
        total = kernel - stride if same else 2 * (kernel // 2)
        self.before, self.after = total // 2, total - total // 2
        self.act, self.eps = act, eps

    def forward(self, x):
        scale = self.gamma / (self.var + self.eps).sqrt()
        weight = self.conv.weight * scale.view(-1, 1, 1, 1)
        padding = self.before
        if self.before != self.after:
            x, padding = F.pad(x, (self.before, self.after) * 2), 0
        y = F.conv2d(x, weight, self.beta - scale * self.mean, self.conv.stride, padding, 1,
                     self.conv.groups)
        return self.act(y) if self.act else y


class MbConv(nn.Module):
    def __init__(self, inp, out, expand, kernel, stride):
        super().__init__()
        mid = inp * expand
        conv = lambda *a, **k: FoldedConv(*a, same=True, eps=1e-3, **k)
        layers = [conv(inp, mid, 1, act=F.relu6)] if expand != 1 else []
        layers += [conv(mid, mid, kernel, stride, mid, act=F.relu6), conv(mid, out, 1)]
        self.layers, self.residual = nn.Sequential(*layers), stride == 1 and inp == out

    def forward(self, x):
        y = self.layers(x)
        return y + x if self.residual else y


class Bottleneck(nn.Module):
    def __init__(self, inp, mid, stride):
        super().__init__()
        out = 4 * mid
        self.body = nn.Sequential(FoldedConv(inp, mid, 1, act=F.relu),
                                  FoldedConv(mid, mid, 3, stride, act=F.relu), FoldedConv(mid, out, 1))
        self.down = FoldedConv(inp, out, 1, stride) if stride != 1 or inp != out else None

    def forward(self, x):
        return F.relu(self.body(x) + (self.down(x) if self.down is not None else x))


def backbone(preset):
    """(frozen part, trained part, channels)."""
    if preset == "nano":
        groups = [FoldedConv(3, 32, 3, 2, same=True, act=F.relu6, eps=1e-3)]
        for kernel, stride, expand, inp, out, count in [
            (3, 1, 1, 32, 16, 1), (3, 2, 6, 16, 24, 2), (5, 2, 6, 24, 40, 2), (3, 2, 6, 40, 80, 3),
            (5, 1, 6, 80, 112, 3),
        ]:
            groups += [MbConv(out if i else inp, out, expand, kernel, 1 if i else stride)
                       for i in range(count)]
        return nn.Sequential(*groups[:6]), nn.Sequential(*groups[6:]), 112
    stem = [FoldedConv(3, 64, 7, 2, act=F.relu), nn.MaxPool2d(3, 2, 1)]
    stages, inp = [], 64
    for mid, count, stride in [(64, 3, 1), (128, 4, 2), (256, 6, 2)]:
        for i in range(count):
            stages.append(Bottleneck(inp, mid, 1 if i else stride))
            inp = 4 * mid
    return nn.Sequential(*stem, *stages[:7]), nn.Sequential(*stages[7:]), 1024


class Attention(nn.Module):
    def __init__(self, d, heads):
        super().__init__()
        self.w, self.b = nn.Parameter(torch.empty(3 * d, d)), nn.Parameter(torch.zeros(3 * d))
        nn.init.xavier_uniform_(self.w)
        self.out, self.heads = nn.Linear(d, d), heads

    def forward(self, q, k, v):
        d = q.shape[-1]
        parts = [F.linear(t, w, b).view(t.shape[0], t.shape[1], self.heads, -1).transpose(1, 2)
                 for t, w, b in zip((q, k, v), self.w.chunk(3), self.b.chunk(3))]
        y = F.scaled_dot_product_attention(*parts)
        return self.out(y.transpose(1, 2).reshape(q.shape[0], -1, d))


class Layer(nn.Module):
    """Encoder layer, or decoder layer with `cross`."""

    def __init__(self, d, heads, ff, dropout, cross):
        super().__init__()
        self.attend = Attention(d, heads)
        self.cross = Attention(d, heads) if cross else None
        self.up, self.down = nn.Linear(d, ff), nn.Linear(ff, d)
        self.norms = nn.ModuleList(nn.LayerNorm(d) for _ in range(3 if cross else 2))
        self.p = dropout

    def forward(self, x, code, memory=None, keys=None):
        drop = lambda t: F.dropout(t, self.p, self.training)
        q = x + code
        x = self.norms[0](x + drop(self.attend(q, q, x)))
        if self.cross is not None:
            x = self.norms[1](x + drop(self.cross(x + code, keys, memory)))
        return self.norms[-1](x + drop(self.down(drop(F.relu(self.up(x))))))


class Net(nn.Module):
    def __init__(self, preset, c, dropout):
        super().__init__()
        d = c["width"]
        self.frozen, self.trained, channels = backbone(preset)
        self.frozen.requires_grad_(False)
        self.neck = nn.Conv2d(channels, d, 3, 1, 1, bias=False)
        k = c["hidden"]
        self.boxes = nn.Sequential(nn.Linear(4, k), nn.BatchNorm1d(k), nn.ReLU(), nn.Linear(k, d),
                                   nn.BatchNorm1d(d), nn.ReLU(), nn.Linear(d, d))
        self.e_fg, self.e_test = (nn.Parameter(torch.randn(1, 1, d)) for _ in range(2))
        self.encoder = nn.ModuleList(Layer(d, c["heads"], c["ff"], dropout, False)
                                     for _ in range(c["enc"]))
        self.decoder = nn.ModuleList(Layer(d, c["heads"], c["ff"], dropout, True)
                                     for _ in range(c["dec"]))
        self.norm = nn.LayerNorm(d)
        self.cls, self.reg = nn.Linear(d, d), nn.Linear(d, d)
        tower = []
        for _ in range(4):
            tower += [nn.Conv2d(d, d, 3, 1, 1), nn.GroupNorm(1, d), nn.ReLU()]
        self.tower = nn.Sequential(*tower, nn.Conv2d(d, 4, 3, 1, 1))
        side, bands = c["crop"] // 16, d // 4
        omega = torch.arange(1, bands + 1) * (side / bands * math.pi)
        centre = (torch.arange(side) + 0.5) / side
        x = centre[None, :, None].expand(side, side, 1) * omega
        y = centre[:, None, None].expand(side, side, 1) * omega
        pair = lambda f: torch.stack([f(x), f(y)], -1).flatten(2)
        code = torch.cat([pair(torch.sin), pair(torch.cos)], -1)
        self.register_buffer("code", code.reshape(1, side * side, d))

    def forward(self, templates, search, labels, ltrb):
        b, n = search.shape[0], templates.shape[0]
        with torch.no_grad():
            x = self.frozen(torch.cat([templates, search]))
        x = self.neck(self.trained(x))
        c, h, w = x.shape[1:]
        x = x * (math.sqrt(1 / c) * (c * h * w / (x.pow(2).sum((1, 2, 3), True) + 1e-5)).sqrt())
        tokens = x.flatten(2).transpose(1, 2)
        boxes = self.boxes(ltrb.flatten(2).transpose(1, 2).reshape(-1, 4)).view(n, h * w, c)
        target = tokens[:n] + labels.reshape(n, -1, 1) * self.e_fg + boxes
        t = n // b
        x = torch.cat([target.reshape(b, t * h * w, c), tokens[n:] + self.e_test], 1)
        code = self.code.repeat(1, t + 1, 1)
        for layer in self.encoder:
            x = layer(x, code)
        keys, token = x + code, torch.zeros(b, 1, c)
        for layer in self.decoder:
            token = layer(token, self.e_fg, x, keys)
        token = self.norm(token)
        encoded = x[:, -h * w:]
        scores = (encoded @ self.cls(token).transpose(1, 2)).view(b, h, w)
        weighted = encoded * (encoded @ self.reg(token).transpose(1, 2))
        return scores, self.tower(weighted.transpose(1, 2).reshape(b, c, h, w)).exp()


def loss(scores, label, ltrb, target, region):
    background = label < 0.05
    error = torch.where(background, F.relu(scores), scores) - label.masked_fill(background, 0)
    p, t = ltrb.permute(0, 2, 3, 1)[region], target.permute(0, 2, 3, 1)[region]
    area = lambda b: (b[:, 0] + b[:, 2]) * (b[:, 1] + b[:, 3])
    inter, hull = area(torch.minimum(p, t)), area(torch.maximum(p, t)) + 1e-7
    union = area(p) + area(t) - inter + 1e-7
    giou = inter / union - (hull - union) / hull
    return 100 * error.pow(2).mean() + (1 - giou).mean()


def synthetic(c, templates=2):
    s, f, b = c["crop"], c["crop"] // 16, c["batch"]
    cell = (torch.arange(f) * 16 + 8.0) / s
    y, x = torch.meshgrid(cell, cell, indexing="ij")
    left, top, right, bottom = 0.38, 0.4, 0.6, 0.6
    ltrb = torch.stack([x - left, y - top, right - x, bottom - y])
    label = torch.exp(-0.5 * ((x - 0.49) ** 2 + (y - 0.5) ** 2) / 0.05**2)
    n = b * templates
    return (torch.randn(n, 3, s, s), torch.randn(b, 3, s, s), label.repeat(n, 1, 1),
            ltrb.repeat(n, 1, 1, 1), label.repeat(b, 1, 1), ltrb.repeat(b, 1, 1, 1))


def cpu_seconds():
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def main():
    ap = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ap.add_argument("--preset", choices=PRESETS, default="nano")
    for name in ("crop", "batch", "steps"):
        ap.add_argument(f"--{name}", type=int)
    ap.add_argument("--threads", type=int, help="default: PyTorch's own choice")
    ap.add_argument("--dropout", type=float, default=0.05)
    ap.add_argument("--channels-last", action="store_true")
    ap.add_argument("--fused", action="store_true", help="fused AdamW")
    a = ap.parse_args()
    if a.threads:
        torch.set_num_threads(a.threads)
    torch.manual_seed(1)
    c = dict(PRESETS[a.preset])
    c.update({k: v for k in ("crop", "batch", "steps") if (v := getattr(a, k))})
    net = Net(a.preset, c, a.dropout).train()
    templates, search, labels, ltrb, target, target_ltrb = synthetic(c)
    if a.channels_last:
        net = net.to(memory_format=torch.channels_last)
        templates, search = (t.contiguous(memory_format=torch.channels_last)
                             for t in (templates, search))
    trained = [p for p in net.parameters() if p.requires_grad]
    early = {id(p) for p in net.trained.parameters()}
    optimiser = torch.optim.AdamW(
        [dict(params=[p for p in trained if id(p) in early], lr=6e-5),
         dict(params=[p for p in trained if id(p) not in early], lr=3e-4)],
        weight_decay=1e-4, fused=a.fused or None)
    average = [p.detach().clone() for p in net.parameters()]

    def step():
        marks = [time.perf_counter()]
        scores, boxes = net(templates, search, labels, ltrb)
        total = loss(scores, target, boxes, target_ltrb, target >= 0.05)
        value = total.item()
        marks.append(time.perf_counter())
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        marks.append(time.perf_counter())
        with torch.no_grad():
            norm = torch.nn.utils.get_total_norm([p.grad for p in trained if p.grad is not None]) \
                if hasattr(torch.nn.utils, "get_total_norm") else torch.stack(
                    [p.grad.norm() for p in trained if p.grad is not None]).norm()
            assert math.isfinite(norm.item())
            optimiser.step()
            torch._foreach_lerp_(average, list(net.parameters()), 0.002)
        marks.append(time.perf_counter())
        return value, [later - earlier for earlier, later in zip(marks, marks[1:])]

    for _ in range(2):
        step()
    parts, best = [0.0] * 3, math.inf
    cpu, wall = cpu_seconds(), time.perf_counter()
    for _ in range(c["steps"]):
        value, times = step()
        parts = [x + y for x, y in zip(parts, times)]
        best = min(best, sum(times))
    wall, cpu = time.perf_counter() - wall, cpu_seconds() - cpu
    samples, n = c["steps"] * c["batch"], c["steps"]
    print(json.dumps(dict(
        preset=a.preset, crop=c["crop"], batch=c["batch"], steps=n, torch=torch.__version__,
        threads=torch.get_num_threads(), channels_last=a.channels_last, fused=a.fused,
        samples_per_s=samples / wall, cpu_ms_per_sample=1e3 * cpu / samples,
        forward_ms=1e3 * parts[0] / n, backward_ms=1e3 * parts[1] / n, update_ms=1e3 * parts[2] / n,
        best_step_ms=1e3 * best, last_loss=value)))


if __name__ == "__main__":
    main()
