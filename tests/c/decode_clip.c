/* An independent decoder of `lsdt-clip` streams whose rig the model knows, written from docs/format.md alone.

   decode_clip STREAM POSITIONS LEVELS BONES
   writes the joint positions in cm (float32, frames x joints x 3) before rotations are fitted to them,
   the quantised levels (int32, clip after clip, coordinates x frequencies x components), and the bones in cm (float64). */
#include <math.h>

#include "bits.h"
#include "container.h"
#include "lsdt_clip.h"
#include "range_decoder.h"

enum { JOINTS = LSDT_CLIP_JOINTS, BONES = LSDT_CLIP_JOINTS + LSDT_CLIP_ENDS, BANDS = 17, SYMBOLS = 48, LONGEST = 240 };

typedef struct {
    const int16_t (*scale)[BANDS][JOINTS];
    const uint16_t (*count)[SYMBOLS], (*run)[SYMBOLS], (*value)[SYMBOLS];
    const uint8_t (*positions)[JOINTS], (*values)[31];
} Tables;

#define TABLES(L)                                                                                                      \
    {lsdt_clip_runs_##L##_scale, lsdt_clip_runs_##L##_count,      lsdt_clip_runs_##L##_run,                           \
     lsdt_clip_runs_##L##_value, lsdt_clip_paper_##L##_position, lsdt_clip_paper_##L##_value}

static Tables tables_of(int length) {
    static const Tables all[3] = {TABLES(60), TABLES(120), TABLES(240)};
    return all[length * length < 60 * 120 ? 0 : length * length < 120 * 240 ? 1 : 2];
}

typedef struct {
    int at, scale;
} Place;

static int larger_first(const void *a, const void *b) {
    const Place *p = a, *q = b;
    return p->scale != q->scale ? q->scale - p->scale : p->at - q->at;
}

static int floor_log2(uint64_t value) {
    int result = -1;
    for (; value; value >>= 1) result++;
    return result;
}

static int clamp(int value, int low, int high) { return value < low ? low : value > high ? high : value; }

/* Rounds down; C leaves open what >> makes of negative numbers. */
static int shift_down(int value, int bits) { return (int)floor((double)value / (1 << bits)); }

static void scan_of(Place *scan, const int16_t (*scale)[JOINTS], int length, int64_t rate) {
    for (int k = 0; k < length; k++) {
        uint64_t eighths = (uint64_t)(k * rate * 4 / length);
        int band = k == 0 ? 0 : 1 + clamp(floor_log2(eighths * eighths) - 2, 0, BANDS - 2);
        for (int i = 0; i < JOINTS; i++) {
            Place place = {k * JOINTS + i, scale[band][i]};
            scan[k * JOINTS + i] = place;
        }
    }
    qsort(scan, (size_t)length * JOINTS, sizeof *scan, larger_first);
}

static void decode_runs(RangeDecoder *d, int32_t *levels, int length, int64_t rate, int index, int *previous) {
    static Place scan[LONGEST * JOINTS];
    Tables t = tables_of(length);
    int size = length * JOINTS;
    for (int c = 0; c < 3; c++, levels += size) {
        int64_t count = decode_integer(d, t.count[previous[c] < 0 ? 0 : 1 + previous[c] / 2], &previous[c]);
        if (count > size) fail("a clip says that too many coefficients are not zero");
        scan_of(scan, t.scale[c], length, rate);
        int64_t at = 0;
        for (int64_t n = 0; n < count; n++, at++) {
            uint64_t ratio = (uint64_t)((at + 1) * (at + 1) * 256 / ((count + 1) * (count + 1)));
            at += decode_integer(d, t.run[clamp(floor_log2(ratio), 0, 15)], NULL);
            if (at >= size) fail("a run of zeros leads out of its clip");
            int context = clamp(shift_down((scan[at].scale - index + 112) * 3, 5) + 6, 0, 15);
            int32_t magnitude = decode_integer(d, t.value[context], NULL) + 1;
            levels[scan[at].at] = decode_raw(d, 1) ? -magnitude : magnitude;
        }
    }
}

static int32_t read_value(Bits *b, const uint8_t *lengths) {
    int symbol = read_huffman(b, lengths, 31);
    if (symbol < 30) return symbol & 1 ? symbol / 2 + 1 : -(symbol / 2 + 1);
    symbol = (int)read_bits(b, 6);
    if (symbol >= SYMBOLS) fail("a chunk holds a value that no encoder wrote");
    int32_t magnitude = join(symbol, (uint32_t)read_bits(b, raw_bits(symbol))) + 16;
    return read_bits(b, 1) ? -magnitude : magnitude;
}

static void decode_paper(Bits *b, int32_t *levels, int length, int index) {
    Tables t = tables_of(length);
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < length; k++, levels += JOINTS) {
            int count = (int)read_bits(b, floor_log2(JOINTS) + 1);
            if (count > JOINTS) fail("a coefficient vector says that too many are not zero");
            while (count--) {
                int position = read_huffman(b, t.positions[c], JOINTS);
                levels[position] = read_value(b, t.values[index / 16]);
            }
        }
}

/* Dequantisation, inverse basis, inverse DCT. */
static void synthesise(const int32_t *levels, float *positions, int length, int index) {
    static double spectrum[LONGEST][JOINTS];
    const double pi = 3.14159265358979323846;
    for (int c = 0; c < 3; c++, levels += length * JOINTS) {
        memset(spectrum, 0, sizeof spectrum);
        for (int k = 0; k < length; k++)
            for (int i = 0; i < JOINTS; i++)
                if (levels[k * JOINTS + i]) {
                    double coefficient = (double)levels[k * JOINTS + i] * lsdt_clip_step_cm[index];
                    for (int j = 0; j < JOINTS; j++) spectrum[k][j] += coefficient * lsdt_clip_basis[c][i][j];
                }
        for (int n = 0; n < length; n++) {
            double sum[JOINTS] = {0};
            for (int k = 0; k < length; k++) {
                double entry = sqrt((k ? 2.0 : 1.0) / length) * cos(pi * (2 * n + 1) * k / (2 * length));
                for (int j = 0; j < JOINTS; j++) sum[j] += entry * spectrum[k][j];
            }
            for (int j = 0; j < JOINTS; j++) positions[(n * JOINTS + j) * 3 + c] = (float)sum[j];
        }
    }
}

static void read_lengths(Bytes section, double (*bones)[3], int octave) {
    Bits bits = {{section.data + 2, section.size - 2, 0}, 0};
    int64_t residual[BONES];
    int size = section.data[1], used = 0;
    for (int b = 0; b < BONES; b++) {
        const double *mean = lsdt_clip_rig_bones[b];
        double length = sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]);
        if (length == 0) continue;
        int partner = lsdt_clip_rig_partner[used], shift = 23 + octave;
        int order = floor_log2((uint64_t)lsdt_clip_rig_spread[used]) - (16 + octave);
        int64_t predicted = ((int64_t)lsdt_clip_rig_lengths[used] * size + ((int64_t)1 << (shift - 1))) >> shift;
        residual[used] = read_golomb(&bits, order > 0 ? order : 0) + (partner >= 0 ? residual[partner] : 0);
        for (int c = 0; c < 3; c++) bones[b][c] = mean[c] / length * ldexp((double)(predicted + residual[used]), octave);
        used++;
    }
}

static void read_offsets(Bytes section, double (*bones)[3], int octave) {
    Bits bits = {{section.data + 2, section.size - 2, 0}, 0};
    int order = section.data[1];
    if (order > 60) fail("the skeleton's bones are coded with an impossible order");
    for (int b = 0; b < BONES; b++)
        for (int c = 0; c < 3; c++) {
            int64_t residual = read_bits(&bits, 1) ? read_golomb(&bits, order) : 0;
            bones[b][c] = ldexp(rint(ldexp(lsdt_clip_rig_bones[b][c], -octave)) + (double)residual, octave);
        }
}

static void read_bones(Bytes section, double (*bones)[3], int index) {
    int octave = index / 16 - 13;
    if (section.size < 2) fail("the skeleton section ends early");
    if (section.data[0] > 1) fail("the stream brings its own skeleton, which this decoder cannot read");
    (section.data[0] == 0 ? read_lengths : read_offsets)(section, bones, octave);
}

static void decode_chunk(const Stream *s, Bytes payload, int frames, int32_t *levels, float *positions) {
    int form = s->params[0] >> 7, clip_frames = (s->params[0] & 127) * 60, index = s->params[1];
    double rate = rint(1 / (s->frame_time < 0 ? lsdt_clip_frame_time : s->frame_time));
    RangeDecoder coder = range_decoder(payload);
    Bits bits = {payload, 0};
    int previous[3] = {-1, -1, -1};
    while (frames > 0) {
        int length = frames < clip_frames ? frames : clip_frames;
        if (form) decode_runs(&coder, levels, length, rate < 1 ? 1 : (int64_t)rate, index, previous);
        else decode_paper(&bits, levels, length, index);
        synthesise(levels, positions, length, index);
        levels += length * JOINTS * 3;
        positions += length * JOINTS * 3;
        frames -= length;
    }
}

static void check(const Stream *s) {
    if (s->codec != 1 || s->param_count != 2) fail("this is no lsdt-clip stream");
    int clips = s->params[0] & 127;
    if (clips != 1 && clips != 2 && clips != 4) fail("the stream has clips of an unknown length");
    uint64_t chunk = (uint64_t)clips * 240;
    if (s->chunk_frames != (chunk < s->frames ? chunk : s->frames)) fail("the stream has chunks of a wrong length");
    if (s->frame_time > 0 && s->frame_time < 1e-9) fail("the header gives an impossible frame time");
    if (s->has_digest && memcmp(s->digest, lsdt_clip_digest, 4)) fail("the stream needs another model");
}

static void save(const char *path, const void *data, size_t size) {
    FILE *file = fopen(path, "wb");
    if (!file || fwrite(data, 1, size, file) != size || fclose(file)) fail("cannot write a result");
}

static Bytes load(const char *path) {
    FILE *file = fopen(path, "rb");
    if (!file || fseek(file, 0, SEEK_END)) fail("cannot open the stream");
    size_t size = (size_t)ftell(file);
    uint8_t *data = allocate(size, 1);
    rewind(file);
    if (fread(data, 1, size, file) != size) fail("cannot read the stream");
    fclose(file);
    Bytes result = {data, size, 0};
    return result;
}

int main(int argc, char **argv) {
    if (argc != 5) fail("usage: decode_clip STREAM POSITIONS LEVELS BONES");
    Bytes file = load(argv[1]);
    Stream s = read_stream(file.data, file.size);
    check(&s);
    size_t values = (size_t)s.frames * JOINTS * 3;
    int32_t *levels = allocate(values, sizeof *levels);
    float *positions = allocate(values, sizeof *positions);
    double bones[BONES][3] = {{0}};
    read_bones(s.skeleton, bones, s.params[1]);
    for (uint64_t n = 0; n < s.chunk_count; n++) {
        uint64_t first = n * s.chunk_frames, left = s.frames - first;
        size_t at = (size_t)first * JOINTS * 3;
        decode_chunk(&s, s.chunks[n], (int)(left < s.chunk_frames ? left : s.chunk_frames), levels + at, positions + at);
    }
    save(argv[2], positions, values * sizeof *positions);
    save(argv[3], levels, values * sizeof *levels);
    save(argv[4], bones, sizeof bones);
    free(positions);
    free(levels);
    free(s.chunks);
    free((void *)file.data);
    return 0;
}
