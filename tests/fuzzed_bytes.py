"""Bytes of good files changed at random, the same for the same seed, whatever the format."""


def changed_bytes(content, rng):
    """A few bytes cut, changed, doubled or moved."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5))):
        place = rng.randrange(len(data)) if data else 0
        length = rng.choice((1, 1, 2, 8, 100))
        match rng.randrange(6):
            case 0:
                del data[place:]
            case 1:
                del data[place : place + length]
            case 2:
                data[place : place + length] = rng.randbytes(length)
            case 3:
                data[place:place] = data[place : place + length]
            case 4:
                data[place:place] = rng.randbytes(length)
            case 5 if data:
                data[place] ^= 1 << rng.randrange(8)
    return bytes(data)
