/* The range decoder and what is built on it: docs/format.md, "Range coder" and "Unsigned integers". */
#ifndef JMC_RANGE_DECODER_H
#define JMC_RANGE_DECODER_H

#include "container.h"

typedef struct {
    Bytes bytes;
    uint64_t low, range, point;
} RangeDecoder;

/* The next 32 bits, zeros past the end. */
static uint32_t next_word(RangeDecoder *d) {
    uint32_t word = 0;
    for (int n = 0; n < 4; n++) word = word << 8 | (d->bytes.at < d->bytes.size ? d->bytes.data[d->bytes.at++] : 0u);
    return word;
}

static RangeDecoder range_decoder(Bytes bytes) {
    RangeDecoder d = {bytes, 0, UINT64_MAX, 0};
    d.point = (uint64_t)next_word(&d) << 32;
    d.point |= next_word(&d);
    return d;
}

static uint32_t quantile_of(const RangeDecoder *d, int bits) {
    uint64_t quantile = (d->point - d->low) / (d->range >> 24);
    if (quantile >> 24) fail("a chunk holds bytes that no encoder wrote");
    return (uint32_t)(quantile >> (24 - bits));
}

static void narrow(RangeDecoder *d, uint32_t start, uint32_t width, int bits) {
    uint64_t scale = d->range >> 24;
    d->low += scale * ((uint64_t)start << (24 - bits));
    d->range = scale * ((uint64_t)width << (24 - bits));
    if (d->range >> 32 == 0) {
        d->low <<= 32;
        d->range <<= 32;
        d->point = d->point << 32 | next_word(d);
    }
}

/* `table` holds frequencies less one that sum to 65536 with them. */
static int decode_symbol(RangeDecoder *d, const uint16_t *table) {
    uint32_t quantile = quantile_of(d, 16), start = 0;
    int symbol = 0;
    while (start + table[symbol] + 1u <= quantile) start += table[symbol++] + 1u;
    narrow(d, start, table[symbol] + 1u, 16);
    return symbol;
}

static uint32_t decode_raw(RangeDecoder *d, int count) {
    uint32_t value = 0;
    while (count > 0) {
        int bits = count < 12 ? count : 12;
        uint32_t high = quantile_of(d, bits);
        narrow(d, high, 1, bits);
        value = value << bits | high;
        count -= bits;
    }
    return value;
}

static int raw_bits(int symbol) { return symbol < 8 ? 0 : (symbol - 8) / 2 + 2; }

static int32_t join(int symbol, uint32_t raw) {
    return symbol < 8 ? symbol : (int32_t)((2u + (symbol & 1)) << ((symbol - 8) / 2 + 2)) + (int32_t)raw;
}

/* The symbol, too, where `symbol` is not NULL. */
static int32_t decode_integer(RangeDecoder *d, const uint16_t *table, int *symbol) {
    int s = decode_symbol(d, table);
    if (symbol) *symbol = s;
    return join(s, decode_raw(d, raw_bits(s)));
}

#endif
