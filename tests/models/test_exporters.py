"""Exporters end to end: tiny networks of the same architecture with random weights, PyTorch against ONNX Runtime."""

import json
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest

from openvocab_occ.segmentation.card_files import read_card
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.picture import prepare
from openvocab_occ.segmentation.selftest import check, picture

transformers = pytest.importorskip("transformers", reason="the exporters need transformers (extra dev)")
pytest.importorskip("onnxscript", reason="torch exports through onnxscript (extra dev)")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),  # of torch.export and onnxscript
]
torch = pytest.importorskip("torch")
EXPORTERS = Path(__file__).resolve().parents[2] / "models" / "export"
WORDS = ["a", "photo", "of", "the", "on", "street", "truck", "red", "cars", "two", "car", "."]
END = len(WORDS) + 1


@pytest.fixture
def exporter(monkeypatch):
    """Import a script of models/export, which import each other by name."""
    monkeypatch.syspath_prepend(str(EXPORTERS))

    def load(name):
        for module in ("local", "towers", "maskclip", "masks", "segformer"):
            sys.modules.pop(module, None)
        return __import__(name)

    return load


def folder(path, *models, mean=(0.5, 0.4, 0.3), std=(0.2, 0.3, 0.4)):
    """Save models and what goes with them, as a user would have them."""
    torch.manual_seed(0)
    for model in models:
        model.save_pretrained(path)
    (path / "preprocessor_config.json").write_text(json.dumps({"image_mean": mean, "image_std": std}))
    (path / "tokenizer_config.json").write_text(json.dumps({"pad_token_id": 0}))
    vocabulary = {word: n for n, word in enumerate(["[UNK]", *WORDS, "[END]"])}
    content = {
        "version": "1.0", "truncation": None, "padding": None, "added_tokens": [], "normalizer": None,
        "pre_tokenizer": {"type": "Whitespace"}, "post_processor": None, "decoder": None,
        "model": {"type": "WordLevel", "vocab": vocabulary, "unk_token": "[UNK]"},
    }  # fmt: skip
    (path / "tokenizer.json").write_text(json.dumps(content))
    return path


def sizes(**more):
    return {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 3, "num_attention_heads": 4, **more}


def clip(path):
    text = sizes(vocab_size=END + 1, max_position_embeddings=10, eos_token_id=END, bos_token_id=0, pad_token_id=0)
    text["projection_dim"] = 24
    vision = sizes(image_size=32, patch_size=8, projection_dim=24)
    config = transformers.CLIPConfig(text_config=text, vision_config=vision, projection_dim=24)
    torch.manual_seed(1)
    model = transformers.CLIPModel(config).eval()
    for p in model.parameters():  # as they come, all vectors are nearly alike
        torch.nn.init.normal_(p, std=0.2)
    return folder(path, model), model


def siglip(path):
    text = sizes(vocab_size=END + 1, max_position_embeddings=10, eos_token_id=END, bos_token_id=0, pad_token_id=0,
                 projection_size=32)  # fmt: skip
    config = transformers.SiglipConfig(text_config=text, vision_config=sizes(image_size=32, patch_size=8))
    torch.manual_seed(1)
    model = transformers.SiglipModel(config).eval()
    return folder(path, model), model


def unit(x):
    return (x / np.linalg.norm(x, axis=-1, keepdims=True)).astype(np.float32)


def ids(texts):
    vocabulary = {word: n for n, word in enumerate(["[UNK]", *WORDS, "[END]"])}
    rows = [[vocabulary.get(w, 0) for w in text.replace(".", " .").split()] + [END] for text in texts]
    return torch.tensor([row + [0] * (10 - len(row)) for row in rows])


def says_nothing(path):
    """No path, file or stack trace of this machine is left in a file."""
    content = path.read_bytes()
    assert not onnx.load(str(path)).metadata_props
    for trace in (
        b"site-packages",
        b"stack_trace",
        b".py",
        b"/tmp",
        str(Path.cwd()).encode(),
        str(Path.home()).encode(),
    ):
        assert trace not in content, trace


def passes(card_file, encoder):
    card = read_card(card_file)
    assert card.selftest is not None
    assert all(result.passed for result in check(encoder, card.selftest))
    return card


def image_tensor(card, size):
    return torch.from_numpy(prepare(picture(card.selftest)[: size[0], : size[1]], card.input))[None].permute(0, 3, 1, 2)


@pytest.mark.parametrize("family", [clip, siglip])
def test_towers(exporter, tmp_path, family):
    weights, model = family(tmp_path / "weights")
    card_file = exporter("towers").main(weights, tmp_path / "out")
    encoder = load_encoder(tmp_path / "out" / "image.onnx")
    card = passes(card_file, encoder)
    for name in ("image.onnx", "text.onnx"):
        says_nothing(tmp_path / "out" / name)
    with torch.inference_mode():
        found = model.get_text_features(ids(["a photo of a red truck.", "a photo of a cars."]))
        found = getattr(found, "pooler_output", found)
        from openvocab_occ.segmentation.text import OnnxTextEncoder

        text = OnnxTextEncoder(card.text, tmp_path / "out")
        punctuated = ["a photo of a red truck.", "a photo of a cars."]
        if family is siglip:
            found = model.get_text_features(ids(["a photo of a red truck", "a photo of a cars"]))
            found = getattr(found, "pooler_output", found)
        np.testing.assert_allclose(text.encode(punctuated), unit(found.numpy()), atol=2e-4)
        square = picture(card.selftest)[:64, :64]
        pixels = torch.from_numpy(prepare(square, card.input))[None].permute(0, 3, 1, 2)
        wanted = model.get_image_features(pixels)
        wanted = getattr(wanted, "pooler_output", wanted)
        np.testing.assert_allclose(encoder._embed([square]), unit(wanted.numpy()), atol=2e-4)
    assert card.score.kind == ("sigmoid" if family is siglip else "relevancy")


def test_maskclip_patches_are_clips_own(exporter, tmp_path):
    """Of one layer MaskCLIP is: embed, norm, value, out, norm, project; written out here with plain torch."""
    weights, model = clip(tmp_path / "weights")
    card_file = exporter("maskclip").main(weights, tmp_path / "out", (32, 48))
    encoder = load_encoder(tmp_path / "out" / "dense.onnx")
    card = passes(card_file, encoder)
    says_nothing(tmp_path / "out" / "dense.onnx")
    assert encoder.dim == 24
    cells = encoder.encode([picture(card.selftest)[:32, :48]])[0].cells
    assert cells.shape == (4, 6, 24)
    vision = model.vision_model
    seen = {}
    last = vision.encoder.layers[-1]
    hook = last.register_forward_pre_hook(
        lambda _, args, kwargs: seen.update(x=(args or [kwargs["hidden_states"]])[0]), with_kwargs=True
    )
    with torch.inference_mode():
        vision(pixel_values=image_tensor(card, (32, 48)), interpolate_pos_encoding=True)
        x = seen["x"]
        value = last.self_attn.out_proj(last.self_attn.v_proj(last.layer_norm1(x)))
        wanted = model.visual_projection(vision.post_layernorm(value))[0, 1:].reshape(4, 6, -1)
    hook.remove()
    np.testing.assert_allclose(cells, unit(wanted.numpy()), atol=1e-3)


def test_masks_with_vectors(exporter, tmp_path):
    clip_weights, _ = clip(tmp_path / "clip")
    backbone = transformers.SwinConfig(
        embed_dim=12, depths=[1, 1, 1, 1], num_heads=[1, 2, 2, 2], window_size=4, image_size=64,
        out_features=["stage1", "stage2", "stage3", "stage4"],
    )  # fmt: skip
    decoder = transformers.DetrConfig(
        d_model=32, encoder_layers=1, decoder_layers=2, encoder_attention_heads=2, decoder_attention_heads=2,
        encoder_ffn_dim=16, decoder_ffn_dim=16, num_queries=7,
    )  # fmt: skip
    config = transformers.MaskFormerConfig(
        backbone_config=backbone, decoder_config=decoder, mask_feature_size=32, fpn_feature_size=32, num_labels=3
    )
    torch.manual_seed(2)
    proposer = transformers.MaskFormerForInstanceSegmentation(config).eval()
    mask_weights = folder(tmp_path / "masks", proposer)
    card_file = exporter("masks").main(clip_weights, mask_weights, tmp_path / "out", (64, 64), 2)
    encoder = load_encoder(tmp_path / "out" / "masks.onnx")
    card = passes(card_file, encoder)
    says_nothing(tmp_path / "out" / "masks.onnx")
    image = picture(card.selftest)[:64, :64]
    found = encoder.encode_masks([image])[0]
    with torch.inference_mode():
        masks = proposer(pixel_values=image_tensor(card, (64, 64))).masks_queries_logits[0].sigmoid().numpy()
    assert found.ids.shape == masks.shape[1:]
    assert found.embeddings.shape[1] == 24
    best = masks.argmax(axis=0)
    both = (found.ids >= 0) & (masks.max(axis=0) > 0.501)
    _, renamed = np.unique(best[found.ids >= 0], return_inverse=True)
    assert (renamed == found.ids[found.ids >= 0]).mean() > 0.98  # nearly equal masks may swap
    assert both.any() or masks.max() < 0.501


def test_segformer(exporter, tmp_path):
    config = transformers.SegformerConfig(
        depths=[1, 1, 1, 1], hidden_sizes=[8, 12, 16, 20], num_attention_heads=[1, 2, 2, 2], decoder_hidden_size=16,
        id2label={0: "road", 1: "car", 2: "sky"}, label2id={"road": 0, "car": 1, "sky": 2},
    )  # fmt: skip
    torch.manual_seed(3)
    model = transformers.SegformerForSemanticSegmentation(config).eval()
    weights = folder(tmp_path / "weights", model)
    card_file = exporter("segformer").main(weights, tmp_path / "out", (64, 96))
    encoder = load_encoder(tmp_path / "out" / "segformer.onnx")
    card = passes(card_file, encoder)
    says_nothing(tmp_path / "out" / "segformer.onnx")
    assert encoder.labels == ("road", "car", "sky")
    with torch.inference_mode():
        logits = model(pixel_values=image_tensor(card, (64, 96))).logits[0].softmax(dim=0).permute(1, 2, 0).numpy()
    cells = encoder.encode([picture(card.selftest)[:64, :96]])[0].cells
    np.testing.assert_allclose(cells, logits, atol=1e-4)
