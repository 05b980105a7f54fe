/* CRC-64/ECMA-182 as the OpenIGTLink header has it of the body, for the C parts of the package; without Python.
 *
 * Polynomial 0x42F0E1EBA9EA3693, most significant bit first, initial value 0, no final XOR.  On x86-64 with carry-less
 * multiplication, 128 or 256 bytes are folded at a time ("Fast CRC Computation for Generic Polynomials Using PCLMULQDQ",
 * Intel, 2009); elsewhere tables take 8 bytes at a time.  All have the same results.
 */
#ifndef IGTL_GATEWAY_CRC64_H
#define IGTL_GATEWAY_CRC64_H

#include <stdint.h>
#include <string.h>
#include <sys/types.h>

#define CRC64_POLYNOMIAL 0x42F0E1EBA9EA3693u

/* Row i: the CRC of each byte, followed by i bytes of zero. */
static uint64_t crc64_tables[8][256];

/* Continue the CRC of the bytes before with the tables. */
static inline uint64_t crc64_portable(uint64_t crc, const uint8_t *data, ssize_t size)
{
    for (; size >= 8; data += 8, size -= 8) {
        uint64_t word;
        memcpy(&word, data, 8);
        crc ^= __builtin_bswap64(word);
        uint64_t next = 0;
#pragma GCC unroll 8
        for (int i = 0; i < 8; i++)
            next ^= crc64_tables[i][crc >> 8 * i & 0xFF];
        crc = next;
    }
    for (; size > 0; data++, size--)
        crc = crc64_tables[0][(crc >> 56) ^ *data] ^ crc << 8;
    return crc;
}

#if defined(__x86_64__)
#include <immintrin.h>

#define CRC64_FOLDS __attribute__((target("pclmul,ssse3")))
#define CRC64_LANES 8

static int crc64_folds;      /* the processor has the instructions */
static uint64_t crc64_power[4][2]; /* x^(n+64) and x^n mod P for n = 64, 128, 1024 and 2048 */
static uint64_t crc64_row_power[3][2]; /* the same for rows: from the begin of one to its word, by a row, by all lanes */
static uint64_t crc64_quotient;    /* x^128 / P without its x^64 */

/* Load 16 bytes as a polynomial: the first byte has the highest powers. */
CRC64_FOLDS static inline __m128i crc64_load(const uint8_t *data)
{
    const __m128i reverse = _mm_set_epi8(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return _mm_shuffle_epi8(_mm_loadu_si128((const __m128i *)(const void *)data), reverse);
}

/* Multiply by x^n mod P, to a polynomial of at most 128 bits; ``power``: the row of crc64_power for n. */
CRC64_FOLDS static inline __m128i crc64_shift(__m128i value, __m128i power)
{
    return _mm_xor_si128(_mm_clmulepi64_si128(value, power, 0x11), _mm_clmulepi64_si128(value, power, 0x00));
}

/* Return the CRC of what ``value`` stands for and of ``size`` more bytes. */
CRC64_FOLDS static inline uint64_t crc64_end(__m128i value, const uint8_t *data, ssize_t size)
{
    const __m128i by_128 = _mm_set_epi64x((int64_t)crc64_power[1][0], (int64_t)crc64_power[1][1]);
    for (; size >= 16; data += 16, size -= 16)
        value = _mm_xor_si128(crc64_shift(value, by_128), crc64_load(data));
    /* the last 1 to 15 bytes: what they push out of the lower 128 bits is folded into these */
    if (size) {
        uint8_t bytes[48] = {0};
        const __m128i reversed = crc64_load((const uint8_t *)&value);
        memcpy(bytes + 16, &reversed, 16);
        memcpy(bytes + 32, data, (size_t)size);
        value = _mm_xor_si128(crc64_shift(crc64_load(bytes + size), by_128), crc64_load(bytes + 16 + size));
    }
    /* append 64 bits of zero and divide by P (Barrett) */
    const __m128i by_64 = _mm_set_epi64x((int64_t)crc64_power[0][0], (int64_t)CRC64_POLYNOMIAL);
    value = _mm_xor_si128(_mm_clmulepi64_si128(value, by_64, 0x11), _mm_slli_si128(value, 8));
    const __m128i quotient = _mm_set_epi64x((int64_t)crc64_quotient, 0);
    const __m128i times = _mm_xor_si128(_mm_clmulepi64_si128(value, quotient, 0x11), value);
    return (uint64_t)_mm_cvtsi128_si64(_mm_xor_si128(_mm_clmulepi64_si128(times, by_64, 0x01), value));
}

/* Fold values that follow each other to one. */
CRC64_FOLDS static inline __m128i crc64_join(const __m128i *values, int count)
{
    const __m128i by_128 = _mm_set_epi64x((int64_t)crc64_power[1][0], (int64_t)crc64_power[1][1]);
    __m128i value = values[0];
    for (int i = 1; i < count; i++)
        value = _mm_xor_si128(crc64_shift(value, by_128), values[i]);
    return value;
}

/* Continue the CRC of the bytes before with ``size`` >= 16 bytes. */
CRC64_FOLDS static inline uint64_t crc64_folded(uint64_t crc, const uint8_t *data, ssize_t size)
{
    __m128i value = _mm_xor_si128(crc64_load(data), _mm_set_epi64x((int64_t)crc, 0));
    data += 16, size -= 16;
    if (size >= 16 * (2 * CRC64_LANES - 1)) {
        const __m128i by_1024 = _mm_set_epi64x((int64_t)crc64_power[2][0], (int64_t)crc64_power[2][1]);
        __m128i lanes[CRC64_LANES] = {value};
        for (int i = 1; i < CRC64_LANES; i++, data += 16, size -= 16)
            lanes[i] = crc64_load(data);
        for (; size >= 16 * CRC64_LANES; data += 16 * CRC64_LANES, size -= 16 * CRC64_LANES) {
#pragma GCC unroll 8
            for (int i = 0; i < CRC64_LANES; i++)
                lanes[i] = _mm_xor_si128(crc64_shift(lanes[i], by_1024), crc64_load(data + 16 * i));
        }
        value = crc64_join(lanes, CRC64_LANES);
    }
    return crc64_end(value, data, size);
}

#if defined(__clang__) || __GNUC__ >= 9
/* The same with 32 bytes in each lane. */
#define CRC64_WIDE __attribute__((target("avx2,pclmul,vpclmulqdq")))
#define CRC64_WIDE_BYTES (32 * CRC64_LANES)

static int crc64_is_wide; /* the processor has the instructions */

CRC64_WIDE static inline __m256i crc64_load_wide(const uint8_t *data)
{
    const __m128i reverse = _mm_set_epi8(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return _mm256_shuffle_epi8(_mm256_loadu_si256((const __m256i *)(const void *)data), _mm256_broadcastsi128_si256(reverse));
}

/* Continue the CRC of the bytes before with ``size`` >= CRC64_WIDE_BYTES bytes. */
CRC64_WIDE static inline uint64_t crc64_folded_wide(uint64_t crc, const uint8_t *data, ssize_t size)
{
    const __m128i power = _mm_set_epi64x((int64_t)crc64_power[3][0], (int64_t)crc64_power[3][1]);
    const __m256i by_2048 = _mm256_broadcastsi128_si256(power);
    __m256i lanes[CRC64_LANES];
    for (int i = 0; i < CRC64_LANES; i++)
        lanes[i] = crc64_load_wide(data + 32 * i);
    lanes[0] = _mm256_xor_si256(lanes[0], _mm256_set_epi64x(0, 0, (int64_t)crc, 0));
    data += CRC64_WIDE_BYTES, size -= CRC64_WIDE_BYTES;
    for (; size >= CRC64_WIDE_BYTES; data += CRC64_WIDE_BYTES, size -= CRC64_WIDE_BYTES) {
#pragma GCC unroll 8
        for (int i = 0; i < CRC64_LANES; i++) {
            const __m256i next = crc64_load_wide(data + 32 * i);
            const __m256i high = _mm256_clmulepi64_epi128(lanes[i], by_2048, 0x11);
            const __m256i low = _mm256_clmulepi64_epi128(lanes[i], by_2048, 0x00);
            lanes[i] = _mm256_xor_si256(_mm256_xor_si256(high, low), next);
        }
    }
    __m128i values[2 * CRC64_LANES];
    memcpy(values, lanes, sizeof values);
    return crc64_end(crc64_join(values, 2 * CRC64_LANES), data, size);
}
#endif
#endif

/* Continue the CRC of the bytes before; ``crc`` is 0 for the first ones. */
static inline uint64_t crc64_update(uint64_t crc, const uint8_t *data, ssize_t size)
{
#if defined(__x86_64__)
#if defined(CRC64_WIDE)
    if (crc64_is_wide && size >= 2 * CRC64_WIDE_BYTES)
        return crc64_folded_wide(crc, data, size);
#endif
    if (crc64_folds && size >= 16)
        return crc64_folded(crc, data, size);
#endif
    return crc64_portable(crc, data, size);
}

/* Rows whose bytes are 0 except for 16 of them. */
#define CRC64_ROW_BYTES 136
#define CRC64_WORD_AT 96
#define CRC64_ROW_END (CRC64_ROW_BYTES - CRC64_WORD_AT - 16)

#if defined(__x86_64__)
CRC64_FOLDS static inline __m128i crc64_row_shift(int i)
{
    return _mm_set_epi64x((int64_t)crc64_row_power[i][0], (int64_t)crc64_row_power[i][1]);
}

CRC64_FOLDS static inline uint64_t crc64_folded_rows(uint64_t crc, const uint8_t *word, ssize_t count)
{
    static const uint8_t zeros[CRC64_ROW_END] = {0};
    const __m128i by_row = crc64_row_shift(1), by_lanes = crc64_row_shift(2);
    __m128i lanes[CRC64_LANES];
    ssize_t begun = count < CRC64_LANES ? count : CRC64_LANES;
    for (ssize_t i = 0; i < begun; i++, word += CRC64_ROW_BYTES)
        lanes[i] = crc64_load(word);
    lanes[0] = _mm_xor_si128(lanes[0], crc64_shift(_mm_set_epi64x((int64_t)crc, 0), crc64_row_shift(0)));
    ssize_t left = count - begun;
    for (; left >= CRC64_LANES; left -= CRC64_LANES, word += CRC64_LANES * CRC64_ROW_BYTES) {
#pragma GCC unroll 8
        for (int i = 0; i < CRC64_LANES; i++)
            lanes[i] = _mm_xor_si128(crc64_shift(lanes[i], by_lanes), crc64_load(word + CRC64_ROW_BYTES * i));
    }
    __m128i value = lanes[0];
    for (ssize_t i = 1; i < begun; i++)
        value = _mm_xor_si128(crc64_shift(value, by_row), lanes[i]);
    for (; left > 0; left--, word += CRC64_ROW_BYTES)
        value = _mm_xor_si128(crc64_shift(value, by_row), crc64_load(word));
    return crc64_end(value, zeros, CRC64_ROW_END);
}
#endif

/* Continue the CRC of the bytes before with ``count`` >= 1 rows. */
static inline uint64_t crc64_update_rows(uint64_t crc, const uint8_t *rows, ssize_t count)
{
#if defined(__x86_64__)
    if (crc64_folds)
        return crc64_folded_rows(crc, rows + CRC64_WORD_AT, count);
#endif
    return crc64_portable(crc, rows, count * CRC64_ROW_BYTES);
}

/* Return x^n mod P. */
static inline uint64_t crc64_power_of_x(int n)
{
    uint64_t power = 1;
    for (int i = 0; i < n; i++)
        power = power << 1 ^ (power >> 63 ? CRC64_POLYNOMIAL : 0);
    return power;
}

/* Fill the tables; to be called before anything else here. */
static inline void begin_crc64(void)
{
    for (int byte = 0; byte < 256; byte++) {
        uint64_t crc = (uint64_t)byte << 56;
        for (int bit = 0; bit < 8; bit++)
            crc = crc << 1 ^ (crc >> 63 ? CRC64_POLYNOMIAL : 0);
        crc64_tables[0][byte] = crc;
    }
    for (int row = 1; row < 8; row++)
        for (int byte = 0; byte < 256; byte++) {
            uint64_t crc = crc64_tables[row - 1][byte];
            crc64_tables[row][byte] = crc64_tables[0][crc >> 56] ^ crc << 8;
        }
#if defined(__x86_64__)
    static const int shifts[4] = {64, 128, 16 * CRC64_LANES * 8, 32 * CRC64_LANES * 8};
    for (int i = 0; i < 4; i++) {
        crc64_power[i][0] = crc64_power_of_x(shifts[i] + 64);
        crc64_power[i][1] = crc64_power_of_x(shifts[i]);
    }
    static const int row_shifts[3] = {CRC64_WORD_AT * 8, CRC64_ROW_BYTES * 8, CRC64_LANES * CRC64_ROW_BYTES * 8};
    for (int i = 0; i < 3; i++) {
        crc64_row_power[i][0] = crc64_power_of_x(row_shifts[i] + 64);
        crc64_row_power[i][1] = crc64_power_of_x(row_shifts[i]);
    }
    /* long division of x^128 by P = x^64 + polynomial, below its first digit */
    uint64_t rest = CRC64_POLYNOMIAL;
    crc64_quotient = 0;
    for (int bit = 63; bit >= 0; bit--) {
        if (rest >> 63) {
            crc64_quotient |= (uint64_t)1 << bit;
            rest = rest << 1 ^ CRC64_POLYNOMIAL;
        } else {
            rest <<= 1;
        }
    }
    __builtin_cpu_init();
    crc64_folds = __builtin_cpu_supports("pclmul") && __builtin_cpu_supports("ssse3");
#if defined(CRC64_WIDE)
    crc64_is_wide = crc64_folds && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("vpclmulqdq");
#endif
#endif
}

#endif
