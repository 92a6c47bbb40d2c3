/* Bits, most significant first, and the codes made of them: docs/format.md, "Bits" and "Huffman codes". */
#ifndef JMC_BITS_H
#define JMC_BITS_H

#include "container.h"

typedef struct {
    Bytes bytes;
    size_t at;
} Bits;

static uint64_t read_bits(Bits *b, int count) {
    uint64_t value = 0;
    for (; count > 0; count--, b->at++) {
        if (b->at / 8 >= b->bytes.size) fail("a chunk's bits end early");
        value = value << 1 | (b->bytes.data[b->at / 8] >> (7 - b->at % 8) & 1);
    }
    return value;
}

/* Exp-Golomb of a signed integer. */
static int64_t read_golomb(Bits *b, int order) {
    int extra = 0;
    while (!read_bits(b, 1))
        if (++extra + order > 60) fail("the skeleton holds a bone of impossible length");
    uint64_t leading = (uint64_t)1 << (extra + order);
    int64_t folded = (int64_t)((leading | read_bits(b, extra + order)) - ((uint64_t)1 << order));
    return folded & 1 ? (folded + 1) / 2 : -(folded / 2);
}

/* A canonical Huffman code, walked one length after another: the codes of each length are consecutive integers. */
static int read_huffman(Bits *b, const uint8_t *lengths, int symbols) {
    uint32_t word = 0, first = 0;
    for (int length = 1; length <= 16; length++) {
        uint32_t held = 0;
        word = word << 1 | (uint32_t)read_bits(b, 1);
        first <<= 1;
        for (int s = 0; s < symbols; s++)
            if (lengths[s] == length && first + held++ == word) return s;
        first += held;
    }
    fail("a chunk holds a code that no encoder wrote");
    return 0;
}

#endif
