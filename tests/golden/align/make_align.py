"""Alignment losses and gradients of small fixed inputs, in PyTorch (float64).

    python make_align.py > align.json

Written from the equations of docs/alignment.md with PyTorch's own losses and a hand-written gradient
reversal; it shares no code with the trainer. Numbers are rounded to 9 digits.
"""

import json
import math

import torch
import torch.nn.functional as F

torch.set_default_dtype(torch.float64)
B, D, HIDDEN, DIM = 5, 8, 6, 4


def recipe(offset, *shape):
    """Fixed numbers between -1 and 1 without any structure that matters."""
    n = math.prod(shape)
    return torch.tensor([math.sin(1.7 * i * i + 0.9 * i + offset) for i in range(n)]).reshape(shape)


class Reverse(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, coefficient):
        ctx.coefficient = coefficient
        return x.view_as(x)

    @staticmethod
    def backward(ctx, g):
        return -ctx.coefficient * g, None


# Descriptors as small as real head features are; encoder outputs are of order 1.
INPUTS = {
    "pre.template": 0.1 * recipe(1, B, D),
    "pre.search": 0.1 * recipe(2, B, D),
    "encoder.template": recipe(3, B, D),
    "encoder.search": recipe(4, B, D),
}
PARAMETERS = {
    "discriminator.0.weight": recipe(5, HIDDEN, D),
    "discriminator.0.bias": 0.3 * recipe(6, HIDDEN),
    "discriminator.1.weight": recipe(7, 1, HIDDEN),
    "discriminator.1.bias": 0.3 * recipe(8, 1),
    "projection.0.weight": recipe(9, HIDDEN, D),
    "projection.0.bias": 0.3 * recipe(10, HIDDEN),
    "projection.1.weight": recipe(11, DIM, HIDDEN),
    "projection.1.bias": 0.3 * recipe(12, DIM),
}
THERMAL = {"template": [0, 1, 1, 0, 1], "search": [0, 0, 1, 1, 0]}

# stage, weight, reversal, normalise | stage, weight, temperature, normalise
CASES = {
    "pre-afa": (("pre", 0.5, 0.1, False), None),
    "enc-afa": (("encoder", 0.5, 0.1, False), None),
    "pre-afa-normalised": (("pre", 0.5, 0.1, True), None),
    "pre-cfa": (None, ("pre", 0.1, 0.1, False)),
    "pre-cfa-normalised": (None, ("pre", 0.1, 0.1, True)),
    "enc-cfa": (None, ("encoder", 0.1, 0.1, False)),
    "joint": (("pre", 0.3, 0.1, False), ("encoder", 0.1, 0.1, False)),
    "both-encoder": (("encoder", 0.7, 1.3, False), ("encoder", 0.2, 0.5, False)),
}


def standardised(x, wanted):
    return F.layer_norm(x, (D,), eps=1e-8) if wanted else x


def mlp(p, name, x):
    x = F.relu(F.linear(x, p[f"{name}.0.weight"], p[f"{name}.0.bias"]))
    return F.linear(x, p[f"{name}.1.weight"], p[f"{name}.1.bias"])


def run(adversarial, contrastive):
    x = {k: v.clone().requires_grad_() for k, v in INPUTS.items()}
    p = {k: v.clone().requires_grad_() for k, v in PARAMETERS.items()}
    out, total = {}, 0.0
    if adversarial:
        stage, weight, reversal, normalise = adversarial
        halves, right = [], 0
        for role in ("template", "search"):
            d = standardised(Reverse.apply(x[f"{stage}.{role}"], reversal), normalise)
            logits = mlp(p, "discriminator", d)[:, 0]
            label = torch.tensor(THERMAL[role], dtype=torch.float64)
            halves.append(F.binary_cross_entropy_with_logits(logits, label))
            right += int(((logits > 0) == (label > 0.5)).sum())
        out["halves"] = [float(h) for h in halves]
        out["adversarial"] = float(0.5 * (halves[0] + halves[1]))
        out["discriminator_accuracy"] = right / (2 * B)
        total = total + weight * 0.5 * (halves[0] + halves[1])
    if contrastive:
        stage, weight, temperature, normalise = contrastive
        t, s = (
            F.normalize(mlp(p, "projection", standardised(x[f"{stage}.{r}"], normalise)))
            for r in ("template", "search")
        )
        logits, own = t @ s.T / temperature, torch.arange(B)
        loss = 0.5 * (F.cross_entropy(logits, own) + F.cross_entropy(logits.T, own))
        out["contrastive"] = float(loss)
        total = total + weight * loss
    total.backward()
    out["loss"] = float(total)
    out["gradients"] = {k: v.grad for k, v in {**x, **p}.items() if v.grad is not None}
    return out


def plain(v):
    if isinstance(v, torch.Tensor):
        return plain(v.flatten().tolist())
    if isinstance(v, dict):
        return {k: plain(x) for k, x in v.items()}
    if isinstance(v, list):
        return [plain(x) for x in v]
    return float(f"{v:.9g}") if isinstance(v, float) else v


cases = {name: run(*case) for name, case in CASES.items()}
print(json.dumps(plain({"inputs": INPUTS, "parameters": PARAMETERS, "thermal": THERMAL, "cases": cases})))
