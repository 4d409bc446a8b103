"""Writes PyTorch files with everything that makes them hard to read, and what is in them as JSON.

    python make_torch_files.py OUT             small files and expected.json (committed here)
    python make_torch_files.py OUT small       pytracking-style checkpoint, small golden configuration
    python make_torch_files.py OUT tomp101     the same at full size (also tomp50)

Weights follow the filling recipe of the golden vectors: values from names. Needs torch; the classes
the files name (`ltr.admin...`) are made up here and exist in no package the reader could import.
"""

import collections
import json
import pathlib
import sys
import types

import numpy as np
import torch

MASK = (1 << 64) - 1


def stream(name, count):
    h = 0xCBF29CE484222325
    for b in name.encode():
        h = ((h ^ b) * 0x100000001B3) & MASK
    with np.errstate(over="ignore"):
        z = np.uint64(h) + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def recipe(name, shape):
    """The recipe's values of a tensor with this state-dict name."""
    if name.endswith("num_batches_tracked"):
        return torch.tensor(0, dtype=torch.int64)
    numel = int(np.prod(shape))
    if name.endswith("running_mean"):
        a, b = 0.0, 0.2
    elif name.endswith("running_var"):
        a, b = 1.0, 0.5
    elif "query_embed_" in name:
        a, b = 0.0, 1.0
    elif len(shape) == 1 and name.endswith("bn3.weight"):
        a, b = 0.3, 0.1
    elif len(shape) == 1 and name.endswith(".weight"):
        a, b = 1.0, 0.2
    elif len(shape) == 1:
        a, b = 0.0, 0.1
    else:
        if name in ("head.classifier.linear.weight", "head.bb_regressor.linear.weight"):
            g = 1 / 64
        elif name == "head.bb_regressor.bbreg_layer.weight":
            g = 0.25
        elif name.startswith("feature_extractor.") or ".tower." in name:
            g = 2.0
        else:
            g = 1.0
        a, b = 0.0, (3.0 * g / (numel // shape[0])) ** 0.5
    name = name.replace("query_embed_fg_decoder", "query_embed_fg")
    r = 2.0 * ((stream(name, numel) >> np.uint64(40)).astype(np.float64) * 2.0**-24) - 1.0
    return torch.from_numpy((a + b * r).astype(np.float32).reshape(shape))


def backbone(base, blocks, prefix=""):
    """Names and shapes of a bottleneck ResNet with all four stages and classifier."""
    out = []

    def conv(name, o, i, k):
        out.append((f"{prefix}{name}.weight", (o, i, k, k)))

    def bn(name, c):
        for part in ("weight", "bias", "running_mean", "running_var"):
            out.append((f"{prefix}{name}.{part}", (c,)))
        out.append((f"{prefix}{name}.num_batches_tracked", ()))

    conv("conv1", base, 3, 7)
    bn("bn1", base)
    inp = base
    for stage, count in enumerate((*blocks, 1 if base < 64 else 3)):
        mid = base << stage
        for i in range(count):
            at = f"layer{stage + 1}.{i}"
            conv(f"{at}.conv1", mid, inp, 1)
            bn(f"{at}.bn1", mid)
            conv(f"{at}.conv2", mid, mid, 3)
            bn(f"{at}.bn2", mid)
            conv(f"{at}.conv3", 4 * mid, mid, 1)
            bn(f"{at}.bn3", 4 * mid)
            if i == 0:
                conv(f"{at}.downsample.0", 4 * mid, inp, 1)
                bn(f"{at}.downsample.1", 4 * mid)
            inp = 4 * mid
    classes = 2 if base < 64 else 1000
    out.append((f"{prefix}fc.weight", (classes, 32 * base)))
    out.append((f"{prefix}fc.bias", (classes,)))
    return out


def network(base, blocks, d, ff, encoder, decoder, hidden, test_embedding):
    """Names and shapes of a whole network."""
    out = backbone(base, blocks, "feature_extractor.")
    predictor = "head.filter_predictor"

    def affine(name, o, *i):
        out.append((f"{name}.weight", (o, *i)))
        out.append((f"{name}.bias", (o,)))

    def attention(name):
        out.append((f"{name}.in_proj_weight", (3 * d, d)))
        out.append((f"{name}.in_proj_bias", (3 * d,)))
        affine(f"{name}.out_proj", d, d)

    for part, count in (("encoder", encoder), ("decoder", decoder)):
        for i in range(count):
            at = f"{predictor}.transformer.{part}.layers.{i}"
            attention(f"{at}.self_attn")
            if part == "decoder":
                attention(f"{at}.multihead_attn")
            affine(f"{at}.linear1", ff, d)
            affine(f"{at}.linear2", d, ff)
            for n in range(2 if part == "encoder" else 3):
                affine(f"{at}.norm{n + 1}", d)
    affine(f"{predictor}.transformer.decoder.norm", d)
    for i, (o, c) in ((0, (hidden, 4)), (3, (d, hidden)), (6, (d, d))):
        affine(f"{predictor}.box_encoding.{i}", o, c, 1)
        if i < 6:
            at = f"{predictor}.box_encoding.{i + 1}"
            for part in ("weight", "bias", "running_mean", "running_var"):
                out.append((f"{at}.{part}", (o,)))
            out.append((f"{at}.num_batches_tracked", ()))
    out.append((f"{predictor}.query_embed_fg.weight", (1, d)))
    if test_embedding:
        out.append((f"{predictor}.query_embed_test.weight", (1, d)))
    out.append((f"{predictor}.query_embed_fg_decoder.weight", (1, d)))
    out.append(("head.feature_extractor.0.weight", (d, 16 * base, 3, 3)))
    affine("head.classifier.linear", d, d)
    affine("head.bb_regressor.linear", d, d)
    for i in range(4):
        affine(f"head.bb_regressor.tower.{3 * i}", d, d, 3, 3)
        affine(f"head.bb_regressor.tower.{3 * i + 1}", d)
    affine("head.bb_regressor.bbreg_layer", 4, d, 3, 3)
    return out


def filled(shapes):
    net = collections.OrderedDict((name, recipe(name, shape)) for name, shape in shapes)
    fg = "head.filter_predictor.query_embed_fg"
    if f"{fg}.weight" in net:
        # One storage under two names.
        net[f"{fg}_decoder.weight"] = net[f"{fg}.weight"]
    return net


def made_up_class(module, name, **attributes):
    """An object of a class that no reader can import."""
    parts = module.split(".")
    for i in range(len(parts)):
        sys.modules.setdefault(".".join(parts[: i + 1]), types.ModuleType(parts[i]))
    kind = getattr(sys.modules[module], name, None) or type(name, (), {"__module__": module})
    setattr(sys.modules[module], name, kind)
    item = kind()
    item.__dict__.update(attributes)
    return item


def checkpoint(net, function, kwds, args=()):
    """What pytracking's trainer saves."""
    meter = made_up_class("ltr.admin.stats", "AverageMeter", val=torch.tensor(0.5), sum=np.float64(1.5), count=3)
    values = list(net.values())[:2]
    return {
        "epoch": 50,
        "actor_type": "ToMPActor",
        "net_type": "ToMPnet",
        "net": net,
        "net_info": None,
        "constructor": made_up_class(
            "ltr.admin.model_constructor",
            "NetConstructor",
            fun_name=function,
            fun_module="ltr.models.tracking.tompnet",
            args=args,
            kwds=kwds,
        ),
        "optimizer": {
            "state": {i: {"step": 7, "exp_avg": v.clone()} for i, v in enumerate(values)},
            "param_groups": [{"lr": np.float32(1e-4), "params": [0, 1]}],
        },
        "stats": collections.OrderedDict(train=collections.OrderedDict({"Loss/total": meter})),
        "settings": made_up_class(
            "ltr.admin.settings",
            "Settings",
            device=torch.device("cpu"),
            batch_size=np.int64(24),
            rates=collections.defaultdict(float, head=1e-4),
            names={"lasot", "got10k"},
            mean=np.array([0.485, 0.456], dtype=np.float32),
        ),
    }


def hard_traits(net):
    """Number types, strides, offsets and wrappers, without changing any value much."""
    net = net.copy()
    w = "head.classifier.linear.weight"
    net[w] = net[w].t().contiguous().t()
    b = "head.classifier.linear.bias"
    net[b] = torch.stack([net[b], -net[b]], 1)[:, 0]
    big = torch.cat([torch.full((3,), 9.0), net["head.bb_regressor.linear.bias"], torch.zeros(2)])
    d = net[b].shape[0]
    net["head.bb_regressor.linear.bias"] = big[3 : 3 + d]
    net["head.bb_regressor.tower.0.bias"] = net["head.bb_regressor.tower.0.bias"].half()
    net["head.bb_regressor.tower.3.bias"] = net["head.bb_regressor.tower.3.bias"].bfloat16()
    net["head.bb_regressor.tower.6.bias"] = net["head.bb_regressor.tower.6.bias"].double()
    name = "head.bb_regressor.bbreg_layer.bias"
    net[name] = torch.nn.Parameter(net[name])
    name = "head.bb_regressor.tower.10.bias"
    net[name] = torch.full((1,), 0.25).expand(d)
    return net


def traits():
    """Kinds of tensors and objects, each once."""
    base = torch.arange(24, dtype=torch.float32)
    shared = base.view(4, 6)
    return collections.OrderedDict(
        [
            ("plain", base.view(2, 3, 4).clone()),
            ("shared.whole", shared),
            ("shared.rows", shared[1:3]),
            ("shared.columns", shared[:, 1::2]),
            ("shared.transposed", shared.t()),
            ("alias", shared),
            ("half", torch.tensor([1.5, -2.0, 65504.0]).half()),
            ("bfloat16", torch.tensor([1.5, -2.0, 3.0e38]).bfloat16()),
            ("double", torch.tensor([1.0 / 3.0, -1e-300], dtype=torch.float64)),
            ("long", torch.tensor([1, -2, 3_000_000_000])),
            ("int", torch.tensor([1, -2], dtype=torch.int32)),
            ("short", torch.tensor([1, -2], dtype=torch.int16)),
            ("char", torch.tensor([1, -2], dtype=torch.int8)),
            ("byte", torch.tensor([1, 255], dtype=torch.uint8)),
            ("bool", torch.tensor([True, False])),
            ("scalar", torch.tensor(42.0)),
            ("empty", torch.zeros(0, 3)),
            ("expanded", torch.tensor([[7.0]]).expand(2, 3)),
            ("parameter", torch.nn.Parameter(torch.tensor([0.5]))),
            ("version", 3),
            ("note", "no tensor"),
        ]
    )


def described(tensors):
    out = {}
    for name, t in tensors.items():
        if isinstance(t, torch.Tensor):
            values = t.detach().to(torch.float32).flatten()
            head = values[: 24 if len(values) <= 24 else 1].tolist()
            short = [float(f"{v:.9g}") for v in (*head, float(values.double().sum()))]
            out[name] = {"shape": list(t.shape), "values": short[:-1], "sum": short[-1]}
    return out


def small_files(out):
    expected = {}

    def save(name, what, tensors, **how):
        torch.save(what, out / name, **how)
        legacy = how.get("_use_new_zipfile_serialization") is False
        entry = {"format": "legacy" if legacy else "zip", "tensors": described(tensors)}
        entry["others"] = sorted(k for k, v in tensors.items() if not isinstance(v, torch.Tensor))
        expected[name] = entry

    t = traits()
    legacy = {"_use_new_zipfile_serialization": False}
    save("traits.pth", t, t)
    save("traits_legacy.pth", t, t, **legacy)
    save("traits_protocol4.pth", {"state_dict": t, "epoch": 3}, t, pickle_protocol=4)
    save("traits_protocol1.pth", {"model": t}, t, pickle_protocol=1, **legacy)

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.first = torch.nn.Linear(2, 3)
            self.second = torch.nn.Sequential(torch.nn.BatchNorm1d(3))
            self.register_buffer("none", None)

    Net.__module__, Net.__qualname__ = "a.module", "Net"
    made_up_class("a.module", "Net")
    sys.modules["a.module"].Net = Net
    torch.manual_seed(1)
    module = Net()
    save("module.pth", module, module.state_dict())

    tiny = dict(base=1, blocks=(1, 2, 1), d=8, ff=4, encoder=1, decoder=2, hidden=2)
    net = hard_traits(filled(network(**tiny, test_embedding=True)))
    kwds = {"filter_size": np.int64(3), "nhead": 2, "feature_sz": 4, "head_layer": "layer3",
            "frozen_backbone_layers": ("conv1", "bn1"), "backbone_pretrained": True}
    save("pytracking.pth.tar", checkpoint(net, "tompnet_tiny", kwds), net)
    resnet = filled(backbone(1, (1, 2, 1)))
    save("resnet.pth", resnet, resnet, **legacy)
    (out / "expected.json").write_text(json.dumps(expected, indent=None, separators=(",", ":")) + "\n")


PRESETS = {
    "small": (dict(base=16, blocks=(2, 2, 3), d=64, ff=128, encoder=2, decoder=2, hidden=16), 4, 9),
    "tomp50": (dict(base=64, blocks=(3, 4, 6), d=256, ff=2048, encoder=6, decoder=6, hidden=64), 8, 18),
    "tomp101": (dict(base=64, blocks=(3, 4, 23), d=256, ff=2048, encoder=6, decoder=6, hidden=64), 8, 18),
}


def by_recipe(out, preset):
    shape, heads, side = PRESETS[preset]
    kwds = {"filter_size": 1, "feature_sz": side, "num_encoder_layers": shape["encoder"],
            "num_decoder_layers": shape["decoder"]}
    if preset == "small":
        kwds["nhead"] = heads
    for name, test_embedding in ((preset, True), (f"{preset}_no_test", False)):
        if not test_embedding and preset != "small":
            continue
        net = filled(network(**shape, test_embedding=test_embedding))
        torch.save(checkpoint(net, preset, kwds), out / f"{name}.pth.tar")
        torch.save({"net": net}, out / f"{name}_legacy.pth", _use_new_zipfile_serialization=False)


if __name__ == "__main__":
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    if len(sys.argv) > 2:
        by_recipe(folder, sys.argv[2])
    else:
        small_files(folder)
