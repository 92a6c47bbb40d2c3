/* The .jmc container, version 1: docs/format.md, "Container". */
#ifndef JMC_CONTAINER_H
#define JMC_CONTAINER_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    const uint8_t *data;
    size_t size, at;
} Bytes;

typedef struct {
    int codec, param_count, has_digest;
    const uint8_t *params, *digest;
    uint64_t frames, chunk_frames, chunk_count;
    double frame_time, unit_cm; /* -1 where the model's own hold; a unit of 0 is unknown */
    Bytes skeleton;
    Bytes *chunks;
} Stream;

static void fail(const char *message) {
    fprintf(stderr, "%s\n", message);
    exit(2);
}

static void *allocate(size_t count, size_t size) {
    void *memory = calloc(count ? count : 1, size);
    if (!memory) fail("out of memory");
    return memory;
}

static const uint8_t *take(Bytes *b, uint64_t count) {
    if (count > b->size - b->at) fail("the stream ends early");
    b->at += (size_t)count;
    return b->data + b->at - count;
}

static Bytes part(Bytes *b, uint64_t count) {
    Bytes result = {take(b, count), (size_t)count, 0};
    return result;
}

static uint64_t read_varint(Bytes *b) {
    uint64_t value = 0;
    for (int shift = 0; shift < 35; shift += 7) {
        uint8_t byte = *take(b, 1);
        value |= (uint64_t)(byte & 0x7F) << shift;
        if (byte < 0x80) {
            if (byte == 0 && shift) fail("an integer is written longer than it needs");
            return value;
        }
    }
    fail("an integer runs over five bytes");
    return 0;
}

static uint64_t read_little_endian(Bytes *b, int count) {
    const uint8_t *bytes = take(b, (uint64_t)count);
    uint64_t value = 0;
    while (count--) value = value << 8 | bytes[count];
    return value;
}

static double read_double(Bytes *b) {
    uint64_t bits = read_little_endian(b, 8);
    double value;
    memcpy(&value, &bits, 8);
    if (!(value > 0 && value < 1e9)) fail("the header gives an impossible frame time or unit");
    return value;
}

/* CRC-32 as in zlib and PNG; `crc` is that of the bytes before, 0 where there are none. */
static uint32_t crc32_of(uint32_t crc, const uint8_t *data, size_t size) {
    crc = ~crc;
    for (size_t n = 0; n < size; n++) {
        crc ^= data[n];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return ~crc;
}

static Stream read_stream(const uint8_t *data, size_t size) {
    Bytes b = {data, size, 0};
    Stream s;
    if (memcmp(take(&b, 3), "JMC", 3)) fail("this is no jaxmocap stream");
    if (*take(&b, 1) != 1) fail("the stream has another format than 1");
    int codec = *take(&b, 1), flags = *take(&b, 1);
    int unit = flags & 3, states_time = flags & 4, embeds = flags & 8, many = flags & 16;
    if (flags >= 32 || unit == 3) fail("the stream sets unknown flags");
    s.codec = codec & 31;
    s.param_count = codec >> 5;
    s.params = take(&b, (uint64_t)s.param_count);
    s.has_digest = !embeds;
    s.digest = embeds ? NULL : take(&b, 4);
    s.frames = read_varint(&b);
    s.chunk_frames = many ? read_varint(&b) : s.frames;
    if (s.chunk_frames == 0 || s.chunk_frames > s.frames || (many && s.chunk_frames == s.frames))
        fail("the header's frame counts contradict each other");
    s.frame_time = states_time ? read_double(&b) : -1;
    s.unit_cm = unit == 0 ? -1 : unit == 1 ? 0 : read_double(&b);
    s.skeleton = part(&b, read_varint(&b));
    if (embeds) part(&b, read_varint(&b));
    s.chunk_count = (s.frames + s.chunk_frames - 1) / s.chunk_frames;
    if (s.chunk_count > b.size - b.at) fail("the stream ends early");
    s.chunks = allocate((size_t)s.chunk_count, sizeof *s.chunks);
    for (uint64_t n = 0; n < s.chunk_count && many; n++) s.chunks[n].size = (size_t)read_varint(&b);
    if (!many) s.chunks[0].size = b.size - b.at > 4 ? b.size - b.at - 4 : 0; /* the one chunk is all the rest */
    uint32_t header_crc = crc32_of(0, data, b.at);
    for (uint64_t n = 0; n < s.chunk_count; n++) {
        s.chunks[n] = part(&b, s.chunks[n].size);
        if (crc32_of(header_crc, s.chunks[n].data, s.chunks[n].size) != read_little_endian(&b, 4))
            fail("a chunk does not match its checksum");
    }
    if (b.at != b.size) fail("bytes follow the last chunk");
    return s;
}

#endif
