"""What the demo pair is trained with: steps of Muon, repainted vehicles, and texts as means of words."""

import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.segmentation.demo_models import demo_model

FOLDER = demo_model().parent


@pytest.fixture(scope="module", autouse=True)
def scripts():
    """Let the training scripts import each other by name."""
    sys.path.insert(0, str(FOLDER))
    yield
    sys.path.remove(str(FOLDER))
    for name in ("muon", "network", "phrases", "repaint", "scenes", "train", "words"):
        sys.modules.pop(name, None)


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 40), st.integers(2, 40), st.integers(0, 1000))
def test_a_step_keeps_directions_and_evens_out_lengths(rows, columns, seed):
    """Singular vectors stay, singular values that are not tiny go to about 1."""
    from muon import orthogonal

    matrix = torch.from_numpy(np.random.default_rng(seed).normal(size=(rows, columns)))
    u, s, v = torch.linalg.svd(matrix, full_matrices=False)
    found = u.T @ orthogonal(matrix.float()).double() @ v.T
    kept = s > 0.05 * s.norm()
    assert ((found.diagonal()[kept] > 0.6) & (found.diagonal()[kept] < 1.25)).all()
    assert (found - torch.diag(found.diagonal())).abs().max() < 0.02


def test_steps_of_muon_find_a_minimum():
    from muon import Muon

    torch.manual_seed(0)
    wanted = torch.randn(6, 3, 3, 3)
    weight = torch.nn.Parameter(torch.zeros_like(wanted))
    optimizer = Muon([weight], lr=0.0, weight_decay=0.0)
    for step in range(300):
        optimizer.param_groups[0]["lr"] = 0.1 * (1 - step / 300)
        optimizer.zero_grad()
        ((weight - wanted) ** 2).sum().backward()
        optimizer.step()
    assert (weight - wanted).abs().max() < 0.05


def test_weights_of_one_shape_step_as_each_would_alone():
    from muon import Muon

    torch.manual_seed(0)
    first = [torch.randn(shape) for shape in ((6, 4, 3, 3), (6, 4, 3, 3), (40, 8, 1, 1), (6, 4, 3, 3))]
    gradients = [torch.randn_like(weight) for weight in first]

    def stepped(group):
        weights = [torch.nn.Parameter(first[n].clone()) for n in group]
        for weight, n in zip(weights, group, strict=True):
            weight.grad = gradients[n]
        optimizer = Muon(weights, lr=0.1)
        optimizer.step()
        optimizer.step()
        return [weight.detach() for weight in weights]

    for together, n in zip(stepped(range(4)), range(4), strict=True):
        torch.testing.assert_close(together, stepped([n])[0], atol=1e-5, rtol=1e-5)
        assert (together - first[n]).abs().max() > 0.01


def test_agreement_is_the_weighted_cross_entropy_over_what_is_sure():
    import train

    torch.manual_seed(0)
    logits, truth = 8 * torch.randn(50, 30), torch.randint(-1, 2, (50, 30))
    table = torch.where(truth == 1, train._POSITIVE, torch.where(truth == train.UNSURE, 0.0, -1.0))
    each = torch.nn.functional.binary_cross_entropy_with_logits(
        logits, (truth == 1).float(), pos_weight=torch.tensor(train._POSITIVE), reduction="none"
    )
    torch.testing.assert_close(train._agreement(logits, table), each[truth != train.UNSURE].mean())


def test_the_loss_of_colours_is_the_cross_entropy_of_each_thing_that_a_cell_is():
    """A cell of a red van is asked its colour as a van and as a vehicle; what has no colour is asked nothing."""
    import train

    torch.manual_seed(0)
    cells, texts = torch.randn(40, 8), torch.randn(20, 8)
    states = torch.randint(5, (40,))
    truth = SimpleNamespace(
        things=torch.tensor([[1, 1, 0, 0, 1], [1, 0, 0, 1, 0]]).bool(),
        colors=torch.tensor([0, 2, 1, 2, -1]),
        colored=torch.tensor([[[0, 1, 2]], [[3, -1, 4]]]),  # things words colours; -1 is never said
    )
    losses = []
    for thing in range(2):
        for cell, state in zip(cells, states, strict=True):
            if truth.things[thing, state] and truth.colors[state] >= 0:
                rows = truth.colored[thing, 0]
                said = [float(cell @ texts[row]) if row >= 0 else -1e4 for row in rows]
                losses.append(np.log(np.exp(np.array(said) - said[truth.colors[state]]).sum()))
    assert float(train._color_loss(cells, states, texts, truth)) == pytest.approx(np.mean(losses), rel=1e-5)
    none = torch.full_like(states, 4)
    assert train._color_loss(cells, none, texts, truth) == 0


def test_no_vehicle_is_repainted_in_a_colour_that_is_kept_out():
    """A blue truck may become anything but red; what it is stays, and what colour it has is unsure."""
    from phrases import REPAINTED, SKY, State
    from repaint import Repainter

    lexicon = yaml.safe_load((FOLDER / "lexicon.yaml").read_text())
    truck, shadow = State("box truck", "blue", "body", "paint"), State("road", "", "", "asphalt")
    states = [SKY, truck, shadow]
    repaint = Repainter(lexicon, states)
    image = np.full((32, 32, 3), 90, np.uint8)
    numbers = np.full((8, 8), 2, np.int16)
    numbers[2:6, 2:6], image[8:24, 8:24] = 1, (20, 60, 200)
    random, hues = np.random.default_rng(0), set()
    for _ in range(200):
        found, after = repaint(image, numbers, random)
        now = {states[n] for n in after[2:6, 2:6].ravel()}
        assert now in ({truck}, {truck._replace(color=REPAINTED)})
        assert (after[numbers == 2] == 2).all()
        paint = found[8:24, 8:24].reshape(-1, 3)
        hue, saturation, _ = cv2.cvtColor(paint[None].astype(np.float32) / 255, cv2.COLOR_RGB2HSV)[0].mean(axis=0)
        if saturation > 0.2:
            assert abs((hue + 180) % 360 - 180) > 35
            hues.add(int(hue // 30))
            assert (found[:8] == 90).all()
        if {truck} == now:
            assert (found == image).all()
    assert len(hues) >= 6


def test_a_text_is_the_mean_of_its_words():
    """Each word counts as much as any other; silent and unknown ones count for nothing."""
    from network import WordHead
    from words import Words

    torch.manual_seed(0)
    vectors = torch.randn(5, 16) * torch.tensor([0.0, 1.0, 9.0, 0.1, 0.0])[:, None]
    words = Words(["[UNK]", "blue", "van", "roof", "the"], vectors, np.arange(1, 4), torch.arange(5) == 1)
    head = WordHead(16)
    both, blue, van, said = head(*words.shares(["blue van", "blue", "van", "The blue quux van!"])).detach()
    assert float(both @ blue) == pytest.approx(float(both @ van), abs=1e-5)
    assert float(blue @ van) == 0.0
    torch.testing.assert_close(both, said)
    torch.testing.assert_close(both, torch.nn.functional.normalize(blue + van, dim=0))
