// The C++ codec of openigtlink-ng: as ng_codec.py.  ng_messages.hpp is written by the judge from its headers:
// MESSAGES(each) names every message, and each(visitor, message) visits the fields in their order.
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

#include "ng_messages.hpp"
#include "oigtl/pack.hpp"

using Bytes = std::vector<std::uint8_t>;

static std::string hex(const void* data, std::size_t size) {
    static const char* digits = "0123456789abcdef";
    std::string out(2 * size, '0');
    const auto* bytes = static_cast<const std::uint8_t*>(data);
    for (std::size_t i = 0; i < size; ++i) {
        out[2 * i] = digits[bytes[i] >> 4];
        out[2 * i + 1] = digits[bytes[i] & 15];
    }
    return out;
}

static Bytes unhex(const std::string& text, std::size_t from) {
    Bytes out;
    for (std::size_t i = from; i + 1 < text.size(); i += 2)
        out.push_back(static_cast<std::uint8_t>(std::stoi(text.substr(i, 2), nullptr, 16)));
    return out;
}

static std::string bits(double value) {
    std::uint64_t word = 0x7ff8000000000000ULL;
    if (!std::isnan(value)) std::memcpy(&word, &value, 8);
    std::uint8_t big[8];
    for (int i = 0; i < 8; ++i) big[i] = static_cast<std::uint8_t>(word >> (56 - 8 * i));
    return hex(big, 8);
}

static double number(const std::string& word, std::size_t at) {
    const std::uint64_t bits = std::stoull(word.substr(at, 16), nullptr, 16);
    double value;
    std::memcpy(&value, &bits, 8);
    return value;
}

struct Writer {
    std::string out;
    void put(const std::string& word) { out += (out.empty() ? "" : " ") + word; }

    void operator()(std::string& value) { put("x" + hex(value.data(), value.size())); }
    template <class T>
    std::enable_if_t<std::is_integral_v<T>> operator()(T& value) { put("i" + std::to_string(value)); }
    template <class T>
    std::enable_if_t<std::is_floating_point_v<T>> operator()(T& value) { put("F" + bits(value)); }
    template <class T>
    void list(T& values) {
        using E = typename T::value_type;
        if constexpr (std::is_same_v<E, std::uint8_t>) {
            put("x" + hex(values.data(), values.size()));
        } else if constexpr (std::is_integral_v<E>) {
            std::string word = "I";
            for (auto& one : values) word += (word.size() > 1 ? "," : "") + std::to_string(one);
            put(word);
        } else if constexpr (std::is_floating_point_v<E>) {
            std::string word = "F";
            for (auto& one : values) word += bits(one);
            put(word);
        } else {
            put("n" + std::to_string(values.size()));
            for (auto& one : values) (*this)(one);
        }
    }
    template <class E, std::size_t N>
    void operator()(std::array<E, N>& values) { list(values); }
    template <class E>
    void operator()(std::vector<E>& values) { list(values); }
    template <class T>
    std::enable_if_t<std::is_class_v<T>> operator()(T& value) { each(*this, value); }
};

struct Reader {
    std::istringstream words;
    explicit Reader(const std::string& line) : words(line) {}
    std::string next() {
        std::string word;
        if (!(words >> word)) throw std::runtime_error("found too few words");
        return word;
    }

    void operator()(std::string& value) {
        const Bytes data = unhex(next(), 1);
        value.assign(data.begin(), data.end());
    }
    template <class T>
    std::enable_if_t<std::is_integral_v<T>> operator()(T& value) {
        const std::string word = next();
        value = static_cast<T>(word[1] == '-' ? std::stoll(word.substr(1)) : std::stoull(word.substr(1)));
    }
    template <class T>
    std::enable_if_t<std::is_floating_point_v<T>> operator()(T& value) { value = static_cast<T>(number(next(), 1)); }
    template <class E, std::size_t N>
    void operator()(std::array<E, N>& values) {
        std::vector<E> found;
        (*this)(found);
        if (found.size() != N) throw std::runtime_error("found another size");
        for (std::size_t i = 0; i < N; ++i) values[i] = found[i];
    }
    template <class E>
    void operator()(std::vector<E>& values) {
        const std::string word = next();
        values.clear();
        if constexpr (std::is_same_v<E, std::uint8_t>) {
            values = unhex(word, 1);
        } else if constexpr (std::is_integral_v<E>) {
            std::istringstream numbers(word.substr(1));
            for (std::string one; std::getline(numbers, one, ',');) values.push_back(static_cast<E>(std::stoll(one)));
        } else if constexpr (std::is_floating_point_v<E>) {
            for (std::size_t at = 1; at < word.size(); at += 16) values.push_back(static_cast<E>(number(word, at)));
        } else {
            values.resize(std::stoull(word.substr(1)));
            for (auto& one : values) (*this)(one);
        }
    }
    template <class T>
    std::enable_if_t<std::is_class_v<T>> operator()(T& value) { each(*this, value); }
};

template <class T>
std::string decoded(const Bytes& data, Bytes& again) {
    auto envelope = oigtl::unpack_envelope<T>(data);
    again = oigtl::pack_envelope(envelope);
    std::string kind = T::kTypeId;
    Writer words;
    words(envelope.version);
    words(kind);
    words(envelope.device_name);
    words(envelope.timestamp);
    words(envelope.message_id);
    words.put("n" + std::to_string(envelope.metadata.size()));
    for (auto& item : envelope.metadata) {
        words(item.key);
        words(item.value_encoding);
        words(item.value);
    }
    each(words, envelope.body);
    return words.out;
}

template <class T>
Bytes encoded(std::uint16_t version, Reader& words) {
    oigtl::Envelope<T> envelope;
    envelope.version = version;
    words(envelope.device_name);
    words(envelope.timestamp);
    words(envelope.message_id);
    envelope.metadata.resize(std::stoull(words.next().substr(1)));
    for (auto& item : envelope.metadata) {
        words(item.key);
        words(item.value_encoding);
        words(item.value);
    }
    each(words, envelope.body);
    return oigtl::pack_envelope(envelope);
}

struct Codec {
    std::function<std::string(const Bytes&, Bytes&)> decode;
    std::function<Bytes(std::uint16_t, Reader&)> encode;
};

static void answer(const std::string& part) {
    const auto size = static_cast<std::uint32_t>(part.size());
    const std::uint8_t head[4] = {static_cast<std::uint8_t>(size >> 24), static_cast<std::uint8_t>(size >> 16),
                                  static_cast<std::uint8_t>(size >> 8), static_cast<std::uint8_t>(size)};
    std::fwrite(head, 1, 4, stdout);
    std::fwrite(part.data(), 1, part.size(), stdout);
}

int main() {
    std::map<std::string, Codec> codecs;
#define ADD(T) codecs[T::kTypeId] = {decoded<T>, encoded<T>};
    MESSAGES(ADD)
    std::uint8_t head[5];
    while (std::fread(head, 1, 5, stdin) == 5) {
        Bytes data((std::uint32_t(head[1]) << 24) | (head[2] << 16) | (head[3] << 8) | head[4]);
        if (std::fread(data.data(), 1, data.size(), stdin) != data.size()) return 1;
        std::string words, error;
        Bytes out;
        try {
            if (head[0] == 'd') {
                const auto header = oigtl::runtime::unpack_header(data.data(), data.size());
                const auto found = codecs.find(header.type_id);
                if (found == codecs.end()) throw std::runtime_error("no class for " + header.type_id);
                words = found->second.decode(data, out);
            } else {
                Reader reader(std::string(data.begin(), data.end()));
                std::uint16_t version = 0;
                std::string kind;
                reader(version);
                reader(kind);
                out = codecs.at(kind).encode(version, reader);
            }
        } catch (const std::exception& failure) {
            error = failure.what();
            if (error.empty()) error = "error";
            words.clear();
            out.clear();
        }
        answer(words);
        answer(std::string(out.begin(), out.end()));
        answer(error);
        std::fflush(stdout);
    }
    return 0;
}
