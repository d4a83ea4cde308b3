"""Paths through places of an edge: links between places, and the evidence of the best path from each."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, inner, kernel

MAX_LINKS = 12
"""Most links from a place."""
STRETCH_M = 0.1
"""Ways are followed over whole stretches of this length (m), of which a link takes up at least one."""


@inlined
def link_gain(ax, ay, adx, ady, aq, bx, by, bdx, bdy, bq, limits):
    """Returns the evidence (σ · m) of a link from a place to another, or −inf where it is not smooth.

    limits : (longest free gap (m), cosine of the greatest bend, cost of a metre of gap, cost of a bend).
    """
    ex, ey = bx - ax, by - ay
    length = np.sqrt(ex * ex + ey * ey)
    forward_a, forward_b = (ex * adx + ey * ady) / length, (ex * bdx + ey * bdy) / length
    if forward_a < limits[1] or forward_b < limits[1] or adx * bdx + ady * bdy < limits[1]:
        return -np.inf
    bend = (1.0 - forward_a) + (1.0 - forward_b)
    free = min(length, limits[0])
    return free * 0.5 * (aq + bq) - (length - free) * limits[2] - limits[3] * bend * free


@kernel
def find_links(place, quality, order, starts, bins, reach, limits, links, lengths, gains):
    """Fill `links` (n, MAX_LINKS) with the places that may follow each, −1 after the last, `lengths` (m) and `gains`.

    place : (n, 4) x, y (m) and unit vector of the direction. quality : (n,) evidence (σ) less what chance gives.
    order, starts : places sorted by bin and the first of each bin. bins : (x_min_m, y_min_m, size_m, rows, columns).
    reach : (near, far) distances (m); farther places are looked for where none is near.
    """
    rows, columns = int(bins[3]), int(bins[4])
    for i in range(place.shape[0]):
        count = 0
        for far in range(2):
            if count > 0:
                break
            near_m, far_m = (0.0, reach[0]) if far == 0 else (reach[0], reach[1])
            spread = int(np.ceil(far_m / bins[2]))
            column, row = int((place[i, 0] - bins[0]) / bins[2]), int((place[i, 1] - bins[1]) / bins[2])
            for r in range(max(row - spread, 0), min(row + spread + 1, rows)):
                for c in range(max(column - spread, 0), min(column + spread + 1, columns)):
                    for k in range(starts[r * columns + c], starts[r * columns + c + 1]):
                        j = order[k]
                        ex, ey = place[j, 0] - place[i, 0], place[j, 1] - place[i, 1]
                        length = np.sqrt(ex * ex + ey * ey)
                        if j == i or length <= max(near_m, 0.04) or length > far_m:
                            continue
                        gain = link_gain(
                            place[i, 0], place[i, 1], place[i, 2], place[i, 3], quality[i],
                            place[j, 0], place[j, 1], place[j, 2], place[j, 3], quality[j], limits,
                        )  # fmt: skip
                        if gain == -np.inf:
                            continue
                        count = insert(links[i], lengths[i], gains[i], count, j, length, gain)


@inlined
def insert(links, lengths, gains, count, j, length, gain):
    """Put a link into its row, best gain per metre first; the worst falls out of a full row. Returns their number."""
    at = count
    while at > 0 and gains[at - 1] / lengths[at - 1] < gain / length:
        at -= 1
    if at >= MAX_LINKS:
        return count
    last = min(count, MAX_LINKS - 1)
    for k in range(last, at, -1):
        links[k], lengths[k], gains[k] = links[k - 1], lengths[k - 1], gains[k - 1]
    links[at], lengths[at], gains[at] = j, length, gain
    return min(count + 1, MAX_LINKS)


@kernel
def best_ways(links, lengths, gains, memory_m, rounds, near, ahead, following, behind, preceding):
    """Fill `ahead` and `behind` (n,): the evidence of the best path from each place and to it; and the next places.

    Evidence of what lies x metres away counts e^(−x / memory_m): the sum is that of a path of about `memory_m`. The
    next places are those of the best paths of a finite length, so that what lies farther away does not change a way.
    near : (least evidence of places that paths lead through, that length (m)).
    following, preceding : (n,) the next place of the best way, −1 where it ends.
    """
    n = ahead.size
    starts, begins = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    for i in range(n):
        for k in range(links.shape[1]):
            if links[i, k] < 0:
                break
            starts[i + 1] += 1
            begins[links[i, k] + 1] += 1
    for i in range(n):
        starts[i + 1] += starts[i]
        begins[i + 1] += begins[i]
    to, gain, fade = np.empty(starts[n], np.int64), np.empty(starts[n]), np.empty(starts[n])
    back_to, back_gain, back_fade = np.empty(starts[n], np.int64), np.empty(starts[n]), np.empty(starts[n])
    at = begins.copy()
    for i in range(n):
        for m in range(starts[i], starts[i + 1]):
            k = m - starts[i]
            to[m], gain[m], fade[m] = links[i, k], gains[i, k], np.exp(-lengths[i, k] / memory_m)
            back = at[to[m]]
            back_to[back], back_gain[back], back_fade[back] = i, gain[m], fade[m]
            at[to[m]] += 1
    _spread((starts, to, gain, fade), (begins, back_to), rounds, ahead, following)
    _spread((begins, back_to, back_gain, back_fade), (starts, to), rounds, behind, preceding)
    strong = ahead + behind >= near[0]
    stretches = int(near[1] / STRETCH_M + 0.5)
    _follow((starts, to, gain, fade), memory_m, strong, stretches, following)
    _follow((begins, back_to, back_gain, back_fade), memory_m, strong, stretches, preceding)


@inner
def _follow(ways, memory_m, strong, stretches, following):
    """Fill `following` (n,) with the next place on the best path of some stretches from each strong place."""
    starts, to, gain, fade = ways
    places = np.flatnonzero(strong)
    row = np.full(strong.size, -1)
    row[places] = np.arange(places.size)
    first = np.zeros(places.size + 1, np.int64)
    number = 0
    for a in range(places.size):
        for m in range(starts[places[a]], starts[places[a] + 1]):
            number += row[to[m]] >= 0
        first[a + 1] = number
    next_row, links, span = np.empty(number, np.int64), np.empty((number, 2)), np.empty(number, np.int64)
    longest, at = 1, 0
    for a in range(places.size):
        following[places[a]] = -1
        for m in range(starts[places[a]], starts[places[a] + 1]):
            if row[to[m]] >= 0:
                next_row[at], links[at, 0], links[at, 1] = row[to[m]], gain[m], fade[m]
                span[at] = max(int(np.ceil(-memory_m * np.log(fade[m]) / STRETCH_M - 1e-6)), 1)
                longest = max(longest, span[at])
                at += 1
    rows = longest + 1
    value = np.zeros((rows, places.size))
    for k in range(1, stretches + 1):
        now = k % rows
        for a in range(places.size):
            best, then = 0.0, -1
            for m in range(first[a], first[a + 1]):
                if span[m] <= k:
                    before = now - span[m] if span[m] <= now else now - span[m] + rows
                    some = links[m, 0] + value[before, next_row[m]] * links[m, 1]
                    if some > best:
                        best, then = some, next_row[m]
            value[now, a] = best
            if k == stretches and then >= 0:
                following[places[a]] = places[then]


@inner
def _spread(ways, back, rounds, value, following):
    """Fill `value` (n,), the evidence of the best path from each place, and `following`, the next place on it.

    A round looks again at the places from which a way leads to one whose value the round before has changed.
    ways : beginnings of the links of each place, and of each link its end, gain and share of what lies beyond.
    back : beginnings and ends of the links in the other direction.
    """
    starts, to, gain, fade = ways
    begins, back_to = back
    n = value.size
    due, new, waiting = np.arange(n), np.empty(n), np.empty(n, np.bool_)
    count = n
    for _ in range(rounds):
        waiting[:] = False
        for d in range(count):
            i = due[d]
            best, then = 0.0, -1
            for m in range(starts[i], starts[i + 1]):
                some = gain[m] + value[to[m]] * fade[m]
                if some > best:
                    best, then = some, to[m]
            new[d], following[i] = best, then
        changed = False
        for d in range(count):
            i = due[d]
            changed = changed or new[d] > value[i] + 1e-3
            if new[d] != value[i]:
                value[i] = new[d]
                for m in range(begins[i], begins[i + 1]):
                    waiting[back_to[m]] = True
        if not changed:
            break
        count = 0
        for i in range(n):
            if waiting[i]:
                due[count] = i
                count += 1


@kernel
def trace(place, total, following, preceding, ranked, order, starts, bins, limits, chain, owner):
    """Follow the best ways through the strongest places; returns the number of chains.

    The best way back from a place leads to where its chain begins, and the best way on from there is the chain. Ways on
    from different beginnings meet and go on as one: so a chain does not depend on which of its places is strongest.
    total : (n,) evidence of the best path through each place. ranked : places, strongest first. order, starts, bins :
    places sorted by bin, as in :func:`find_links`. limits : (least evidence to begin, least evidence to go on,
    distances within which a chain leaves no second one and no other side of a gutter (m)). chain : (n, 2) filled, in
    chains one after another: the chain's number and the place. owner : (n,) −1 at first; then the chain that holds the
    place or lies beside it.
    """
    n = total.size
    length, chains = 0, 0
    passed = np.full(n, -1, np.int64)
    for s in range(n):
        seed = ranked[s]
        if total[seed] < limits[0]:
            break
        if owner[seed] >= 0:
            continue
        first, at = seed, preceding[seed]
        passed[seed] = s
        while at >= 0 and owner[at] < 0 and total[at] >= limits[1] and passed[at] != s:
            passed[at] = s
            first, at = at, preceding[at]
        at = first
        while at >= 0 and owner[at] < 0 and total[at] >= limits[1]:
            owner[at] = chains
            chain[length, 0], chain[length, 1] = chains, at
            length += 1
            at = following[at]
        cover(place, chain, length, chains, order, starts, bins, (limits[2], limits[3]), owner)
        chains += 1
    return chains, length


@inlined
def cover(place, chain, length, number, order, starts, bins, reach, owner):
    """Assign all places beside the last chain to it, and the other sides of its gutter.

    reach : distances within which places lie beside it, and within which they are the other side of a gutter (m).
    """
    rows, columns = int(bins[3]), int(bins[4])
    far = max(reach[0], reach[1])
    for k in range(length - 1, -1, -1):
        if chain[k, 0] != number:
            break
        j = chain[k, 1]
        west, east = (
            int(np.floor((place[j, 0] - far - bins[0]) / bins[2])),
            int((place[j, 0] + far - bins[0]) / bins[2]),
        )
        south, north = (
            int(np.floor((place[j, 1] - far - bins[1]) / bins[2])),
            int((place[j, 1] + far - bins[1]) / bins[2]),
        )
        for r in range(max(south, 0), min(north + 1, rows)):
            for at in range(starts[r * columns + max(west, 0)], starts[r * columns + min(east, columns - 1) + 1]):
                i = order[at]
                if owner[i] >= 0:
                    continue
                ex, ey = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1]
                apart = ex * ex + ey * ey
                # The other side of a gutter: each lies on the lower side, the left, of the other.
                against = place[i, 2] * place[j, 2] + place[i, 3] * place[j, 3] < -0.7
                gutter = against and ex * place[j, 3] - ey * place[j, 2] < 0.0 and apart <= reach[1] * reach[1]
                if gutter or apart <= reach[0] * reach[0]:
                    owner[i] = number
