"""Current-Prior Fusion by its equations, its rivals by their definitions, the losses by hand."""

import pytest
import torch

from openvocab_occ.errors import ConfigError
from openvocab_occ.networks.fusion import (
    ConvGru,
    CurrentPriorFusion,
    NeuralMapPriorFusion,
    WindowCrossAttention,
    make_fusion,
    where_known,
)
from openvocab_occ.networks.losses import class_weights, geometric_scal, masked_cross_entropy, semantic_scal


@pytest.fixture
def features():
    torch.manual_seed(0)
    return torch.randn(2, 8, 20, 20), torch.randn(2, 8, 20, 20)


@pytest.mark.parametrize("kind", ["cp", "concat_branch", "add_branch", "concat", "add", "nmp"])
def test_every_fusion_keeps_the_shape_and_learns(kind, features):
    current, prior = (f.requires_grad_() for f in features)
    fusion = make_fusion(kind, 8)
    out = fusion(current, prior)
    assert out.shape == current.shape
    out.square().mean().backward()
    assert current.grad is not None
    assert prior.grad is not None
    assert prior.grad.abs().sum() > 0
    assert all(p.grad is not None for p in fusion.parameters())


def test_cp_is_a_mixture(features):
    """Eq. 3-4: alpha lies in (0, 1), and what comes out lies between current and prior."""
    current, prior = features
    fusion = CurrentPriorFusion(8)
    alpha = fusion.alpha(current, prior)
    assert (alpha > 0).all()
    assert (alpha < 1).all()
    assert alpha.shape == current.shape
    out = fusion(current, prior)
    low, high = torch.minimum(current, prior), torch.maximum(current, prior)
    assert (out >= low - 1e-5).all()
    assert (out <= high + 1e-5).all()
    torch.testing.assert_close(out, alpha * current + (1 - alpha) * prior)


@pytest.mark.parametrize(("bias", "expected"), [(40.0, 0), (-40.0, 1)])
def test_saturated_alpha_is_one_side(bias, expected, features):
    fusion = CurrentPriorFusion(8)
    torch.nn.init.zeros_(fusion.w3.weight)
    torch.nn.init.constant_(fusion.w3.bias, bias)
    torch.testing.assert_close(fusion(*features), features[expected])


def test_equal_inputs_stay(features):
    current, _ = features
    torch.testing.assert_close(CurrentPriorFusion(8)(current, current), current)


def test_unknown_cells_keep_the_current_feature(features):
    current, prior = features
    known = torch.zeros(2, 20, 20, dtype=torch.bool)
    known[:, :5] = True
    out = where_known(CurrentPriorFusion(8)(current, prior), current, known)
    assert torch.equal(out[:, :, 5:], current[:, :, 5:])
    assert not torch.equal(out[:, :, :5], current[:, :, :5])


def test_attention_stays_in_its_window(features):
    """A change of the prior in one window changes that window alone."""
    current, prior = features
    attention = WindowCrossAttention(8, heads=2)
    other = prior.clone()
    other[:, :, :10, :10] += 1.0
    change = (attention(current, prior) - attention(current, other)).abs().amax(dim=(0, 1))
    assert change[:10, :10].max() > 0
    assert change[10:].max() == 0
    assert change[:, 10:].max() == 0


def test_attention_does_not_listen_to_empty_places(features):
    current, prior = features
    attention = WindowCrossAttention(8, heads=2)
    prior[:, :, :5, :5] = 0
    k = attention.key_value.bias
    with torch.no_grad():
        before = attention(current, prior)
        k[8:] += 0  # values of empty places would be the bias alone
        prior_noise = prior.clone()
        assert torch.equal(before, attention(current, prior_noise))
    with pytest.raises(ConfigError, match="windows"):
        attention(current[:, :, :15], prior[:, :, :15])


def test_gru_is_its_definition(features):
    current, prior = features
    gru = ConvGru(8)
    both = torch.cat([prior, current], dim=1)
    z, r = gru.update(both).sigmoid(), gru.reset(both).sigmoid()
    q = gru.candidate(torch.cat([r * prior, current], dim=1)).tanh()
    torch.testing.assert_close(gru(current, prior), prior + z * (q - prior))


def test_fusions_have_the_sizes_counted_by_others():
    """At 256 channels and 3x3: 2.95 M for CPFusion; ConvGRU 3.54 M, window attention 0.26 M (its two linear layers)."""

    def millions(module):
        return round(sum(p.numel() for p in module.parameters()) / 1e6, 2)

    with torch.device("meta"):
        assert millions(CurrentPriorFusion(256)) == 2.95
        assert millions(ConvGru(256)) == 3.54
        assert millions(NeuralMapPriorFusion(256)) < 4.0


def test_unknown_fusion():
    with pytest.raises(ConfigError, match="fusion is not known"):
        make_fusion("magic", 8)


class TestLosses:
    """By hand, and at their ends."""

    labels = torch.tensor([[[[0, 1, 2]]]])

    def sure(self, labels, classes=3, strength=50.0):
        return strength * torch.nn.functional.one_hot(labels, classes).float()

    def test_cross_entropy_counts_the_mask_alone(self):
        logits = self.sure(torch.tensor([[[[0, 0, 2]]]]))
        right = torch.tensor([[[[True, False, True]]]])
        assert masked_cross_entropy(logits, self.labels, right) < 1e-6
        assert masked_cross_entropy(logits, self.labels, ~right) > 40
        assert masked_cross_entropy(logits, self.labels, right & ~right) == 0

    def test_scal_is_zero_for_the_truth_and_grows(self):
        mask = torch.ones_like(self.labels, dtype=torch.bool)
        good, bad = self.sure(self.labels), self.sure(torch.tensor([[[[1, 2, 0]]]]), strength=3.0)
        assert geometric_scal(good, self.labels, mask, free=2) < 1e-5
        assert semantic_scal(good, self.labels, mask) < 1e-5
        assert geometric_scal(bad, self.labels, mask, free=2) > 1
        assert semantic_scal(bad, self.labels, mask) > 1

    def test_rare_classes_weigh_more(self):
        weights = class_weights()
        assert weights.shape == (18,)
        assert weights.argmin() == 17
        assert weights.argmax() == 2
