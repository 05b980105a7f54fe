/* The compiled twin of igtl_gateway/convert/express.py: same functions, same results, bit for bit.
 *
 * What they do is told there.  Everything that is not plainly as in the sample gives None, and the general way
 * finds out what it is.  Arithmetic is IEEE 754 double in the order of poses.py; the build forbids the compiler to
 * contract or reorder it (-ffp-contract=off, no -ffast-math).
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#define HEADER_SIZE 58
#define TICKS_AT 34
#define SIZE_AT 42
#define CRC_AT 50
#define MATRIX_BYTES 48
#define QUATERNION_BYTES 28
#define POSE_BYTES 56
#define NAMES_AT 12
#define STAMP_DIGITS 19
#define NS_PER_S 1000000000LL
#define FIRST_OF_19_DIGITS 1000000000000000000LL

static const double ROUNDING = 1e-5;
static double beyond_float32; /* what rounds to infinity as float32: 2^128 - 2^103 */

/* -- bytes ------------------------------------------------------------------------------------------------------- */

static uint64_t crc_table[256];

static uint64_t crc64(const uint8_t *data, Py_ssize_t size)
{
    uint64_t crc = 0;
    for (Py_ssize_t i = 0; i < size; i++)
        crc = crc_table[(crc >> 56) ^ data[i]] ^ (crc << 8);
    return crc;
}

static uint64_t get_u64(const uint8_t *at)
{
    uint64_t value;
    memcpy(&value, at, 8);
    return __builtin_bswap64(value);
}

static void put_u64(uint8_t *at, uint64_t value)
{
    value = __builtin_bswap64(value);
    memcpy(at, &value, 8);
}

static double get_f32(const uint8_t *at)
{
    uint32_t word;
    float value;
    memcpy(&word, at, 4);
    word = __builtin_bswap32(word);
    memcpy(&value, &word, 4);
    return value;
}

static void put_f32(uint8_t *at, double value)
{
    float rounded = (float)value;
    uint32_t word;
    memcpy(&word, &rounded, 4);
    word = __builtin_bswap32(word);
    memcpy(at, &word, 4);
}

/* -- stamps (stamp.py) -------------------------------------------------------------------------------------------- */

static int64_t steps[32];

static int64_t ticks_to_ns(uint64_t ticks)
{
    int64_t ns = (int64_t)(ticks >> 32) * NS_PER_S;
    for (int bit = 0; bit < 32; bit++)
        if (ticks & (0x80000000u >> bit))
            ns += steps[bit];
    return ns;
}

static uint64_t ns_to_ticks(int64_t ns)
{
    if (ns < 0)
        ns = 0;
    int64_t rest = ns % NS_PER_S;
    uint64_t ticks = (uint64_t)(ns / NS_PER_S) << 32;
    for (int bit = 0; bit < 32; bit++)
        if (rest >= steps[bit]) {
            ticks |= 0x80000000u >> bit;
            rest -= steps[bit];
        }
    return ticks;
}

static void put_ros_stamp(uint8_t *at, int64_t ns)
{
    int64_t seconds = ns / NS_PER_S, rest = ns % NS_PER_S;
    if (rest < 0) {
        rest += NS_PER_S;
        seconds -= 1;
    }
    uint32_t words[2] = {(uint32_t)seconds, (uint32_t)rest};
    memcpy(at, words, 8);
}

/* -- poses (poses.py) --------------------------------------------------------------------------------------------- */

static double largest(double a, double b) { return b > a ? b : a; }

static int unit(const double q[4], double out[4])
{
    double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (!(length > 0.0 && length < INFINITY))
        return 0;
    for (int i = 0; i < 4; i++)
        out[i] = q[i] / length;
    return 1;
}

/* Of q and -q the one whose last component that is not 0 is positive. */
static void positive(double q[4])
{
    for (int i = 3; i >= 0; i--)
        if (q[i] != 0.0) {
            if (q[i] < 0.0)
                for (int j = 0; j < 4; j++)
                    q[j] = -q[j];
            return;
        }
}

static int pose_of_matrix(const double m[12], double out[4])
{
    const double a = m[0], b = m[3], c = m[6], d = m[1], e = m[4], f = m[7], g = m[2], h = m[5], i = m[8];
    double off = fabs(a * a + d * d + g * g - 1.0);
    off = largest(off, fabs(b * b + e * e + h * h - 1.0));
    off = largest(off, fabs(c * c + f * f + i * i - 1.0));
    off = largest(off, fabs(a * b + d * e + g * h));
    off = largest(off, fabs(a * c + d * f + g * i));
    off = largest(off, fabs(b * c + e * f + h * i));
    if (!(off <= ROUNDING))
        return 0;
    if (a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0)
        return 0;
    double q[4], trace = a + e + i;
    if (trace >= largest(largest(a, e), i)) {
        q[0] = h - f, q[1] = c - g, q[2] = d - b, q[3] = 1.0 + trace;
    } else if (a >= e && a >= i) {
        q[0] = 1.0 + a - e - i, q[1] = b + d, q[2] = c + g, q[3] = h - f;
    } else if (e >= i) {
        q[0] = b + d, q[1] = 1.0 - a + e - i, q[2] = f + h, q[3] = c - g;
    } else {
        q[0] = c + g, q[1] = f + h, q[2] = 1.0 - a - e + i, q[3] = d - b;
    }
    if (!unit(q, out))
        return 0;
    positive(out);
    return 1;
}

static void matrix_of(const double q[4], double m[9])
{
    const double x = q[0], y = q[1], z = q[2], w = q[3];
    m[0] = 1.0 - 2.0 * (y * y + z * z);
    m[3] = 2.0 * (x * y - z * w);
    m[6] = 2.0 * (x * z + y * w);
    m[1] = 2.0 * (x * y + z * w);
    m[4] = 1.0 - 2.0 * (x * x + z * z);
    m[7] = 2.0 * (y * z - x * w);
    m[2] = 2.0 * (x * z - y * w);
    m[5] = 2.0 * (y * z + x * w);
    m[8] = 1.0 - 2.0 * (x * x + y * y);
}

/* -- the two functions ---------------------------------------------------------------------------------------------- */

static int equal(const uint8_t *a, const uint8_t *b, Py_ssize_t begin, Py_ssize_t end)
{
    return memcmp(a + begin, b + begin, (size_t)(end - begin)) == 0;
}

/* A message that is like the sample but for stamp, CRC, message id and numbers: those numbers, else 0. */
static int numbers_of(const uint8_t *data, const uint8_t *sample, Py_ssize_t size, Py_ssize_t at, Py_ssize_t bytes,
                      int check_crc, double *numbers)
{
    if (!equal(data, sample, 0, TICKS_AT) || !equal(data, sample, SIZE_AT, CRC_AT))
        return 0;
    if (at > HEADER_SIZE && !equal(data, sample, HEADER_SIZE, at - 4)) /* the last 4 bytes there are the message id */
        return 0;
    if (!equal(data, sample, at + bytes, size))
        return 0;
    if (check_crc && crc64(data + HEADER_SIZE, size - HEADER_SIZE) != get_u64(data + CRC_AT))
        return 0;
    for (Py_ssize_t i = 0; i < bytes / 4; i++) {
        numbers[i] = get_f32(data + at + 4 * i);
        if (!isfinite(numbers[i]))
            return 0;
    }
    return 1;
}

static int all_tuples(PyObject *forms)
{
    if (!PyTuple_Check(forms))
        return 0;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(forms); i++)
        if (!PyTuple_Check(PyTuple_GET_ITEM(forms, i)))
            return 0;
    return 1;
}

static PyObject *pose_to_ros(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[7]) || !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError, "pose_to_ros(data, sample, at, bytes, check_crc, own, received_ns, (times, by), forms)");
        return NULL;
    }
    if (!PyBytes_Check(args[0]))
        Py_RETURN_NONE;
    const uint8_t *data = (const uint8_t *)PyBytes_AS_STRING(args[0]);
    const uint8_t *sample = (const uint8_t *)PyBytes_AS_STRING(args[1]);
    Py_ssize_t size = PyBytes_GET_SIZE(args[0]);
    Py_ssize_t at = PyLong_AsSsize_t(args[2]), bytes = PyLong_AsSsize_t(args[3]);
    int check_crc = PyObject_IsTrue(args[4]), own = PyObject_IsTrue(args[5]);
    int64_t received_ns = PyLong_AsLongLong(args[6]);
    double times, by;
    if (PyErr_Occurred() || !PyArg_ParseTuple(args[7], "dd", &times, &by))
        return NULL;
    if (at < HEADER_SIZE || (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES) ||
        at + bytes > PyBytes_GET_SIZE(args[1])) {
        PyErr_SetString(PyExc_ValueError, "pose_to_ros: numbers outside the sample");
        return NULL;
    }
    double numbers[12], pose[7];
    if (size != PyBytes_GET_SIZE(args[1]) || !numbers_of(data, sample, size, at, bytes, check_crc, numbers))
        Py_RETURN_NONE;
    const double *position = numbers;
    if (bytes == MATRIX_BYTES) {
        if (!pose_of_matrix(numbers, pose + 3))
            Py_RETURN_NONE;
        position = numbers + 9;
    } else {
        if (!unit(numbers + 3, pose + 3))
            Py_RETURN_NONE;
        positive(pose + 3);
    }
    for (int i = 0; i < 3; i++)
        pose[i] = position[i] * times / by;
    int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    int64_t stamp_ns = own && source_ns > 0 ? source_ns : received_ns;
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]);
    PyObject *result = PyTuple_New(2 + forms);
    if (!result)
        return NULL;
    PyTuple_SET_ITEM(result, 0, PyLong_FromLongLong(source_ns));
    PyTuple_SET_ITEM(result, 1, PyLong_FromLongLong(stamp_ns));
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *form = PyTuple_GET_ITEM(args[8], i), *template;
        Py_ssize_t stamp_at;
        if (!PyArg_ParseTuple(form, "Sn", &template, &stamp_at)) {
            Py_DECREF(result);
            return NULL;
        }
        Py_ssize_t length = PyBytes_GET_SIZE(template);
        if (length < POSE_BYTES + stamp_at + 8 || stamp_at < 0) {
            PyErr_SetString(PyExc_ValueError, "pose_to_ros: a form without room for stamp and pose");
            Py_DECREF(result);
            return NULL;
        }
        PyObject *cdr = PyBytes_FromStringAndSize(PyBytes_AS_STRING(template), length);
        if (!cdr) {
            Py_DECREF(result);
            return NULL;
        }
        uint8_t *out = (uint8_t *)PyBytes_AS_STRING(cdr);
        put_ros_stamp(out + stamp_at, stamp_ns);
        memcpy(out + length - POSE_BYTES, pose, POSE_BYTES);
        PyTuple_SET_ITEM(result, 2 + i, cdr);
    }
    return result;
}

static PyObject *pose_to_igtl(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[2]) || !PyTuple_Check(args[7]) ||
        !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError,
                        "pose_to_igtl(cdr, sample, names, bytes, own, source_ns, received_ns, (times, by), forms)");
        return NULL;
    }
    double times, by;
    Py_ssize_t first_end, second, end, bytes = PyLong_AsSsize_t(args[3]);
    if (!PyArg_ParseTuple(args[7], "dd", &times, &by) || !PyArg_ParseTuple(args[2], "nnn", &first_end, &second, &end))
        return NULL;
    int own = PyObject_IsTrue(args[4]);
    int64_t source_ns = PyLong_AsLongLong(args[5]), received_ns = PyLong_AsLongLong(args[6]);
    if (PyErr_Occurred())
        return NULL;
    Py_ssize_t size = PyBytes_GET_SIZE(args[1]);
    if (first_end < NAMES_AT || second < first_end || end < second || end > size - POSE_BYTES ||
        (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES)) {
        PyErr_SetString(PyExc_ValueError, "pose_to_igtl: names outside the sample");
        return NULL;
    }
    if (!PyBytes_Check(args[0]) || PyBytes_GET_SIZE(args[0]) != size)
        Py_RETURN_NONE;
    const uint8_t *cdr = (const uint8_t *)PyBytes_AS_STRING(args[0]);
    const uint8_t *sample = (const uint8_t *)PyBytes_AS_STRING(args[1]);
    if (!equal(cdr, sample, 0, 4) || !equal(cdr, sample, NAMES_AT, first_end) || !equal(cdr, sample, second, end))
        Py_RETURN_NONE;
    int32_t seconds;
    uint32_t nanoseconds;
    memcpy(&seconds, cdr + 4, 4);
    memcpy(&nanoseconds, cdr + 8, 4);
    int64_t header_ns = seconds * NS_PER_S + nanoseconds;
    int64_t said_ns = header_ns ? header_ns : source_ns;
    int64_t stamp_ns = own && said_ns > 0 ? said_ns : received_ns;
    double pose[7], numbers[12], q[4];
    memcpy(pose, cdr + size - POSE_BYTES, POSE_BYTES);
    for (int i = 0; i < 7; i++)
        if (!isfinite(pose[i]))
            Py_RETURN_NONE;
    if (!unit(pose + 3, q))
        Py_RETURN_NONE;
    double *position = numbers;
    if (bytes == MATRIX_BYTES) {
        matrix_of(q, numbers);
        position = numbers + 9;
    } else {
        memcpy(numbers + 3, q, sizeof q);
    }
    for (int i = 0; i < 3; i++) {
        position[i] = pose[i] * times / by;
        if (!(fabs(position[i]) < beyond_float32))
            Py_RETURN_NONE;
    }
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]);
    PyObject *result = PyTuple_New(1 + forms);
    if (!result)
        return NULL;
    PyTuple_SET_ITEM(result, 0, PyLong_FromLongLong(stamp_ns));
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *form = PyTuple_GET_ITEM(args[8], i), *template;
        Py_ssize_t at, digits_at;
        if (!PyArg_ParseTuple(form, "Snn", &template, &at, &digits_at)) {
            Py_DECREF(result);
            return NULL;
        }
        Py_ssize_t length = PyBytes_GET_SIZE(template);
        if (at < HEADER_SIZE || at + bytes > length || digits_at + STAMP_DIGITS > length) {
            PyErr_SetString(PyExc_ValueError, "pose_to_igtl: a form without room for the numbers");
            Py_DECREF(result);
            return NULL;
        }
        if (digits_at > 0 ? header_ns < FIRST_OF_19_DIGITS : digits_at < 0 && header_ns) {
            Py_DECREF(result); /* metadata of another size than in the template */
            Py_RETURN_NONE;
        }
        PyObject *message = PyBytes_FromStringAndSize(PyBytes_AS_STRING(template), length);
        if (!message) {
            Py_DECREF(result);
            return NULL;
        }
        uint8_t *out = (uint8_t *)PyBytes_AS_STRING(message);
        put_u64(out + TICKS_AT, ns_to_ticks(stamp_ns));
        for (Py_ssize_t k = 0; k < bytes / 4; k++)
            put_f32(out + at + 4 * k, numbers[k]);
        if (digits_at > 0) {
            int64_t rest = header_ns;
            for (int k = STAMP_DIGITS - 1; k >= 0; k--, rest /= 10)
                out[digits_at + k] = (uint8_t)('0' + rest % 10);
        }
        put_u64(out + CRC_AT, crc64(out + HEADER_SIZE, length - HEADER_SIZE));
        PyTuple_SET_ITEM(result, 1 + i, message);
    }
    return result;
}

/* -- module --------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    {"pose_to_ros", (PyCFunction)(void (*)(void))pose_to_ros, METH_FASTCALL, "See express.py."},
    {"pose_to_igtl", (PyCFunction)(void (*)(void))pose_to_igtl, METH_FASTCALL, "See express.py."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_express", "See express.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__express(void)
{
    for (int byte = 0; byte < 256; byte++) {
        uint64_t crc = (uint64_t)byte << 56;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 0x8000000000000000u ? (crc << 1) ^ 0x42F0E1EBA9EA3693u : crc << 1;
        crc_table[byte] = crc;
    }
    int64_t step = NS_PER_S;
    for (int bit = 0; bit < 32; bit++)
        steps[bit] = step = (step + 1) >> 1;
    beyond_float32 = ldexp(1.0, 128) - ldexp(1.0, 103);
    return PyModule_Create(&definition);
}
