"""Recognize credentials in a text: by the form that their issuers document, and by the name that a value stands under.

One table. A form has a prefix or a structure of its own, so that digests, commit ids, UUIDs and names of images are none; a
value without one is a credential if its name is that of one (`API_TOKEN`) and it is as random as one. Every repetition is
bounded: the texts are other people's.
"""

import math
import re
from collections import Counter
from functools import cache

# What it is, and the pattern of it.
FORMS = (
    ("a private key", r"-----BEGIN [A-Z0-9 ]{0,30}PRIVATE KEY|PuTTY-User-Key-File-\d|\bAGE-SECRET-KEY-1[0-9A-Z]{8}"),
    ("a Google service account's key", r"\"private_key(?:_id)?\"\s{0,8}:\s{0,8}\""),
    ("a Google API key or token", r"\bAIza[\w-]{35}|\bGOCSPX-[\w-]{28}|\bya29\.[\w-]{20}"),
    ("an AWS access key", r"\b(?:AKIA|ASIA|ABIA|ACCA)[0-9A-Z]{16}\b"),
    ("an Azure key", r"\b(?:Account|SharedAccess)Key=[A-Za-z0-9+/]{40}|[?&]sig=[\w%+/]{40}|\b[\w~.-]{3}\dQ~[\w~.-]{31}"),
    ("a GitHub token", r"\bgh[pousr]_[A-Za-z0-9]{36}|\bgithub_pat_\w{22}"),
    ("a GitLab token", r"\bgl(?:pat|oas|dt|rt|cbt|ptt|ft|imt|agent|soat)-[\w-]{20}"),
    ("a Slack token", r"\bxox[abceoprs]-[A-Za-z0-9-]{10}|\bxapp-\d-[A-Z0-9-]{10}|hooks\.slack\.com/services/T\w{6}"),
    ("an Anthropic key", r"\bsk-ant-[\w-]{20}"),
    ("an OpenAI key", r"\bsk-(?:(?:proj|svcacct|admin)-[\w-]{20}|(?=[\w-]{0,30}\d)(?=[\w-]{0,30}[A-Z])[\w-]{20})"),
    ("a Hugging Face token", r"\bhf_[A-Za-z0-9]{30}"),
    ("an NVIDIA key", r"\bnvapi-[\w-]{40}"),
    ("a Stripe key", r"\b[srp]k_(?:live|test)_[A-Za-z0-9]{16}|\bwhsec_[A-Za-z0-9+/]{24}"),
    ("an npm token", r"\bnpm_[A-Za-z0-9]{36}"),
    ("a PyPI token", r"\bpypi-AgE[\w-]{40}"),
    ("a Docker Hub token", r"\bdckr_(?:pat|oat)_[\w-]{20}"),
    ("a DigitalOcean token", r"\bdo[opr]_v1_[a-f0-9]{64}"),
    ("a HashiCorp token", r"\bhv[sbr]\.[\w-]{24}"),
    ("a SendGrid key", r"\bSG\.[\w-]{22}\.[\w-]{43}"),
    ("a Telegram bot's token", r"\b\d{8,10}:AA[\w-]{33}"),
    ("a JSON web token", r"\beyJ[\w-]{10,500}\.eyJ[\w-]{10}"),
    ("a header with a credential", r"(?i:authorization)\s{0,4}[:=]\s{0,4}(?i:basic|bearer)\s{1,4}[\w+/=.~-]{8}"),
)  # fmt: skip
PASSWORD_IN_URL = re.compile(r"://[^/\s:@]{0,256}:([^/\s@]{1,256})@")
ASSIGNED = re.compile(r"([A-Za-z_][\w.-]{0,63})[\"']?\s{0,8}:?[=:]\s{0,8}[\"']?([^\s\"'&;,}]{4,400})")
# Ends of names, without their separators. A longer name is another one: MAX_TOKENS, TOKENIZERS_PARALLELISM, TOKEN_FILE.
PASSWORDS = ("password", "passwd", "passphrase")
SECRETS = ("token", "secret", "credential", "credentials", "psk", "key")
OPEN_KEYS = ("publickey", "primarykey", "foreignkey", "hotkey", "sortkey")
PLACEHOLDER = re.compile(
    r"[$<{(*%]|env:|(?:change.?me|example|placeholder|your|xxx|none|null|true|false)", re.IGNORECASE
)
RANDOM = re.compile(r"[A-Za-z0-9+/=_.~!@#^*-]{16,400}")
BITS_PER_CHARACTER = 3.0
MOST = 2**16


def kind_of(text: str, name: str = "") -> str | None:
    """Return which credential the beginning of a value looks like, None if it does not; `name` is its key."""
    text = text[:MOST]
    if (found := _forms().search(text)) is not None:
        return FORMS[int(str(found.lastgroup).removeprefix("_"))][0]
    if any(not PLACEHOLDER.match(found[1]) for found in PASSWORD_IN_URL.finditer(text)):
        return "a password in a URL"
    named = [(name, text.strip()), *((found[1], found[2]) for found in ASSIGNED.finditer(text))]
    return next((kind for key, value in named if (kind := _named(key, value)) is not None), None)


def _named(name: str, value: str) -> str | None:
    """Return which credential a value under this name is."""
    ending = re.sub(r"[^a-z0-9]", "", name.lower())
    if PLACEHOLDER.match(value) or value.startswith(("/", "./", "~", "http")) or "://" in value:
        return None
    if ending.endswith(PASSWORDS):
        return "a password" if len(value) >= 4 and not value.isdigit() else None
    is_secret = (ending.endswith(SECRETS) and not ending.endswith(OPEN_KEYS)) or name.upper().endswith("_PAT")
    return f"the value of a {ending[-40:]}" if is_secret and _is_random(value) else None


def _is_random(value: str) -> bool:
    """Return whether a value has letters, digits and as many different ones as a random value."""
    if not RANDOM.fullmatch(value) or not any(map(str.isdigit, value)) or not any(map(str.isalpha, value)):
        return False
    shares = [count / len(value) for count in Counter(value).values()]
    return -math.fsum(share * math.log2(share) for share in shares) >= BITS_PER_CHARACTER


@cache
def _forms() -> re.Pattern[str]:
    return re.compile("|".join(f"(?P<_{number}>{pattern})" for number, (_, pattern) in enumerate(FORMS)))
