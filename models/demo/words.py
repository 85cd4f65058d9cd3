"""Word vectors made by text.py, and texts as shares of their words: the text side before its linear head."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml

HERE = Path(__file__).parent
_ALIKE = 0.45  # cosine to a word of the lexicon, above which a random word may mean the same
_ALSO_COLORS = ("gray", "purple", "violet", "pink", "turquoise", "golden")
_COMMON = 14000  # words, by rank, that random ones are drawn from


@dataclass(frozen=True, eq=False)
class Words:
    """A table of words."""

    words: list[str]
    vectors: torch.Tensor
    """Reduced and weighted; zero for silent words and for the unknown one, which is the first."""
    others: np.ndarray
    """Rows of words that mean nothing in the lexicon."""
    colors: torch.Tensor
    """Which words name colours, bool."""

    @property
    def dim(self) -> int:
        """Numbers a word."""
        return self.vectors.shape[1]

    @classmethod
    def read(cls) -> "Words":
        """Read what text.py wrote."""
        with np.load(HERE / "cache" / "words.npz") as stored:
            words, full, reduced = list(map(str, stored["words"])), stored["full"].astype("f4"), stored["reduced"]
        lexicon = yaml.safe_load((HERE / "lexicon.yaml").read_text())
        entries = (entry for part in ("things", "parts", "materials") for entry in lexicon[part].values())
        meant = {w for entry in entries for phrase in entry["words"] for w in phrase.split()} | set(lexicon["colors"])
        number = {word: row for row, word in enumerate(words)}
        known = full[[number[word] for word in meant if word in number]]
        alike = (full @ known.T).max(axis=1) / np.linalg.norm(full, axis=1)
        spoken = np.abs(reduced).sum(axis=1) > 0
        others = np.flatnonzero(spoken & (alike < _ALIKE) & (np.arange(len(words)) < _COMMON))
        named = {*lexicon["colors"], *_ALSO_COLORS}
        colors = torch.tensor([word in named for word in words])
        return cls(words, torch.from_numpy(reduced), others[~colors.numpy()[others]], colors)

    def shares(self, texts: list[str]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return vectors of the words of texts, which are colours, and the share [texts, words] of each in a text."""
        number = {word: row for row, word in enumerate(self.words)}
        rows = [[number.get(word, 0) for word in re.findall(r"[a-z]+", text.lower())] for text in texts]
        used = sorted({row for text in rows for row in text})
        share = torch.zeros(len(texts), len(used))
        for text, own in zip(share, rows, strict=True):
            for row in own:
                text[used.index(row)] += 1 / len(own)
        return self.vectors[used], self.colors[used], share

    def strangers(self, random: np.random.Generator, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return random words and pairs of words that mean nothing in the lexicon, as `shares` does."""
        share = torch.zeros(count, 2 * count)
        second = torch.from_numpy(random.random(count) < 0.3).float() / 2
        share[torch.arange(count), torch.arange(count)] = 1 - second
        share[torch.arange(count), torch.arange(count) + count] = second
        rows = random.choice(self.others, 2 * count)
        return self.vectors[rows], self.colors[rows], share
