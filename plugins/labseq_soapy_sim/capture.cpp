// A software-defined radio that keeps what it is sent: the SoapySDR device "capture".
//
// It has transmit channels only, plays by the computer's clock from a buffer of finite length, and reports
// an underflow when that ran dry, and packets that were lost or late as the module for UHD does. What it was
// sent stands in a file that others map into their memory (struct Header, then a ring of samples for each
// channel); its faults are switched on there.
//
// Arguments: folder (where its files are), channels, buffer (s), patience (s: how long its clock waits for
// samples that are late), speed (of its clock), coerce_rate (Hz), record (samples kept in files), leakage (of
// its local oscillators, part of full scale), time (0: no hardware time; 2: no timed packets), delay (s: of the
// first packet), components (1: no digital tuning), unlocked (ref: its clocks, lo: its local oscillators),
// fault=absent.
//
// With record, the file "trace" gets a line for each change of the transmitters, also by later processes:
// time in s (CLOCK_MONOTONIC), name, two numbers. A process that is killed leaves them as they are.

#include <SoapySDR/Device.hpp>
#include <SoapySDR/Errors.hpp>
#include <SoapySDR/Formats.hpp>
#include <SoapySDR/Registry.hpp>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include <fcntl.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

namespace {

constexpr uint64_t MAGIC = 0x3370616371657362ull;  // changes with the layout below
constexpr size_t RING = 1u << 18;                  // samples of each channel
constexpr size_t CHANNELS = 2;
constexpr size_t MTU = 16384;
constexpr double APART_S = 5e-6;  // by which channel 1 starts after channel 0 without a timed start

enum Fault : uint64_t {
    UNDERFLOW_ONCE = 1, STREAM_ERROR = 2, MUTE_0 = 4, MUTE_1 = 8, STALL = 16, LOST_ONCE = 32, LATE_ONCE = 64
};

struct Header {
    uint64_t magic, ring, sent, underflows, is_active, fault;
    uint64_t silent, silence;  // samples of silence up to now, and those of the last silence that is over
    uint64_t sequence_errors, late_packets;
    double rate_hz, speed, patience_s, t0_s;  // sample n is played at t0 + n / (rate speed), CLOCK_MONOTONIC
    double leakage;
    double frequency_hz[CHANNELS], gain_db[CHANNELS];  // of the samples' zero; gain
    double oscillator_hz[CHANNELS], start_s[CHANNELS];  // where it leaks; when its first sample was played
};

using Sample = uint64_t;  // two floats, never looked into

double now_s() {
    timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}

std::string text(const SoapySDR::Kwargs &args, const std::string &key, const std::string &otherwise) {
    const auto found = args.find(key);
    return found == args.end() ? otherwise : found->second;
}

double number(const SoapySDR::Kwargs &args, const std::string &key, double otherwise) {
    const auto found = args.find(key);
    return found == args.end() ? otherwise : std::stod(found->second);
}

class Capture : public SoapySDR::Device {
public:
    explicit Capture(const SoapySDR::Kwargs &args)
        : folder_(text(args, "folder", ".")), n_channels_(size_t(number(args, "channels", CHANNELS))),
          buffer_s_(number(args, "buffer", 0.05)), coerced_hz_(number(args, "coerce_rate", 0.0)),
          delay_s_(number(args, "delay", 0.0)), time_(number(args, "time", 1.0)), tunes_digitally_(number(args, "components", 2.0) > 1.0),
          n_record_(size_t(number(args, "record", 0.0))), unlocked_(text(args, "unlocked", "")) {
        const std::string path = folder_ + "/ring";
        const size_t size = sizeof(Header) + CHANNELS * RING * sizeof(Sample);
        file_ = open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0600);
        if (file_ < 0) throw std::runtime_error("cannot open " + path);
        if (flock(file_, LOCK_EX | LOCK_NB) != 0) {
            close(file_);
            throw std::runtime_error("the device is busy: another program has opened it");
        }
        if (ftruncate(file_, off_t(size)) != 0) throw std::runtime_error("cannot enlarge " + path);
        void *place = mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_SHARED, file_, 0);
        if (place == MAP_FAILED) throw std::runtime_error("cannot map " + path);
        header_ = static_cast<Header *>(place);
        ring_ = reinterpret_cast<Sample *>(header_ + 1);
        std::memset(place, 0, size);
        header_->ring = RING;
        header_->speed = number(args, "speed", 1.0);
        header_->patience_s = number(args, "patience", 0.0);
        header_->leakage = number(args, "leakage", 0.0);
        header_->magic = MAGIC;
        if (n_record_ > 0) trace_ = std::fopen((folder_ + "/trace").c_str(), "a");
        if (trace_) std::setvbuf(trace_, nullptr, _IOLBF, 4096);
        trace("open");
    }

    ~Capture() override {
        header_->is_active = 0;
        trace("close");
        if (trace_) std::fclose(trace_);
        munmap(header_, sizeof(Header) + CHANNELS * RING * sizeof(Sample));
        close(file_);
    }

    std::string getDriverKey() const override { return "capture"; }
    std::string getHardwareKey() const override { return "capture"; }
    SoapySDR::Kwargs getHardwareInfo() const override { return {{"serial", "simulated"}}; }

    size_t getNumChannels(const int direction) const override {
        return direction == SOAPY_SDR_TX ? n_channels_ : 0;
    }
    std::vector<std::string> getStreamFormats(const int, const size_t) const override { return {SOAPY_SDR_CF32}; }

    void setSampleRate(const int, const size_t, const double rate) override {
        header_->rate_hz = rate;
    }
    double getSampleRate(const int, const size_t) const override { return header_->rate_hz; }

    // The library tunes by these components.
    std::vector<std::string> listFrequencies(const int, const size_t) const override {
        return tunes_digitally_ ? std::vector<std::string>{"RF", "BB"} : std::vector<std::string>{"RF"};
    }
    SoapySDR::RangeList getFrequencyRange(const int, const size_t, const std::string &name) const override {
        return {name == "RF" ? SoapySDR::Range(1e6, 6e9) : SoapySDR::Range(-100e6, 100e6)};
    }
    void setFrequency(const int, const size_t channel, const std::string &name, const double frequency,
                      const SoapySDR::Kwargs &) override {
        const double shift = header_->frequency_hz[channel] - header_->oscillator_hz[channel];
        if (name == "RF") header_->oscillator_hz[channel] = frequency;
        header_->frequency_hz[channel] = header_->oscillator_hz[channel] + (name == "RF" ? shift : frequency);
    }
    double getFrequency(const int, const size_t channel, const std::string &name) const override {
        const double oscillator = header_->oscillator_hz[channel];
        return name == "RF" ? oscillator : header_->frequency_hz[channel] - oscillator;
    }

    std::vector<std::string> listSensors() const override { return {"ref_locked"}; }
    std::string readSensor(const std::string &) const override { return unlocked_ == "ref" ? "false" : "true"; }
    std::vector<std::string> listSensors(const int, const size_t) const override { return {"lo_locked"}; }
    std::string readSensor(const int, const size_t, const std::string &) const override {
        return unlocked_ == "lo" ? "false" : "true";
    }

    bool hasHardwareTime(const std::string &) const override { return time_ > 0.0; }
    long long getHardwareTime(const std::string &) const override { return (long long)(1e9 * (now_s() - zero_s_)); }

    void setGain(const int, const size_t channel, const double gain) override {
        const SoapySDR::Range range = getGainRange(SOAPY_SDR_TX, channel);
        header_->gain_db[channel] = std::min(std::max(gain, range.minimum()), range.maximum());
        trace("gain", double(channel), header_->gain_db[channel]);
    }
    double getGain(const int, const size_t channel) const override { return header_->gain_db[channel]; }
    SoapySDR::Range getGainRange(const int, const size_t) const override { return SoapySDR::Range(0.0, 60.0); }

    SoapySDR::Stream *setupStream(const int direction, const std::string &format,
                                  const std::vector<size_t> &channels, const SoapySDR::Kwargs &) override {
        if (direction != SOAPY_SDR_TX || format != SOAPY_SDR_CF32) throw std::runtime_error("TX of CF32 only");
        for (const size_t channel : channels)
            if (channel >= n_channels_) throw std::runtime_error("no such channel");
        channels_ = channels;
        if (coerced_hz_ > 0.0) header_->rate_hz = coerced_hz_;  // as its clock is set for this number of channels
        for (const size_t channel : channels)
            if (n_record_ > 0)
                records_.push_back(std::fopen((folder_ + "/channel" + std::to_string(channel)).c_str(), "wb"));
        for (std::FILE *record : records_)
            if (record) std::setvbuf(record, nullptr, _IONBF, 0);
        return reinterpret_cast<SoapySDR::Stream *>(this);
    }

    void closeStream(SoapySDR::Stream *) override {
        for (std::FILE *record : records_)
            if (record) std::fclose(record);
        records_.clear();
    }

    size_t getStreamMTU(SoapySDR::Stream *) const override { return MTU; }

    int activateStream(SoapySDR::Stream *, const int, const long long, const size_t) override {
        header_->sent = 0;
        header_->t0_s = now_s();
        header_->is_active = 1;
        return 0;
    }

    int deactivateStream(SoapySDR::Stream *, const int, const long long) override {
        header_->is_active = 0;
        trace("stop");
        return 0;
    }

    int writeStream(SoapySDR::Stream *, const void *const *buffers, const size_t n, int &flags,
                    const long long time_ns, const long timeout_us) override {
        if (!header_->is_active || (header_->fault & STREAM_ERROR)) return SOAPY_SDR_STREAM_ERROR;
        if (time_ > 1.0 && (flags & SOAPY_SDR_HAS_TIME)) return SOAPY_SDR_NOT_SUPPORTED;
        if (header_->sent == 0) start(flags & SOAPY_SDR_HAS_TIME, zero_s_ + 1e-9 * double(time_ns));
        const size_t buffer = size_t(std::max(1.0, buffer_s_ * header_->rate_hz));
        const size_t room = wait_for_room(std::min(std::min(n, MTU), buffer), 1e-6 * double(timeout_us));
        if (room == 0) return SOAPY_SDR_TIMEOUT;
        if (drops(LOST_ONCE, header_->sequence_errors) || drops(LATE_ONCE, header_->late_packets)) return int(room);
        bool silent = true;
        for (size_t i = 0; i < channels_.size(); i++) {
            const Sample *samples = static_cast<const Sample *>(buffers[i]);
            silent = silent && std::all_of(samples, samples + room, [](Sample sample) { return sample == 0; });
            keep(i, samples, room);
        }
        if (!silent && header_->silent) header_->silence = header_->silent;
        header_->silent = silent ? header_->silent + room : 0;
        __atomic_store_n(&header_->sent, header_->sent + room, __ATOMIC_RELEASE);
        return int(room);
    }

    int readStreamStatus(SoapySDR::Stream *, size_t &, int &, long long &, const long timeout_us) override {
        const double deadline_s = now_s() + 1e-6 * double(timeout_us);
        do {
            if (n_told_[0] != header_->underflows) return n_told_[0]++, SOAPY_SDR_UNDERFLOW;
            if (n_told_[1] != header_->sequence_errors) return n_told_[1]++, SOAPY_SDR_CORRUPTION;
            if (n_told_[2] != header_->late_packets) return n_told_[2]++, SOAPY_SDR_TIME_ERROR;
            if (timeout_us > 0) std::this_thread::sleep_for(std::chrono::milliseconds(1));
        } while (now_s() < deadline_s);
        return SOAPY_SDR_TIMEOUT;
    }

private:
    // The channels start together at a time that is not over; otherwise each with its first packet.
    void start(const bool timed, const double time_s) {
        const bool late = timed && time_s <= now_s() + delay_s_;
        header_->late_packets += late;
        header_->t0_s = timed && !late ? time_s : now_s();
        for (size_t channel = 0; channel < CHANNELS; channel++)
            header_->start_s[channel] = header_->t0_s + (timed && !late ? 0.0 : double(channel) * APART_S);
        trace("play", header_->t0_s, clock_hz());
    }

    // Whether a packet is lost: what follows is played earlier, and the phases of all tones jump.
    bool drops(const Fault fault, uint64_t &count) {
        if (!(header_->fault & fault)) return false;
        header_->fault &= ~uint64_t(fault);
        count++;
        return true;
    }

    void trace(const char *name, double first = 0.0, double second = 0.0) {
        if (trace_) std::fprintf(trace_, "%.6f %s %.6f %.6f\n", now_s(), name, first, second);
    }

    double clock_hz() const { return header_->rate_hz * header_->speed; }

    // Samples that were played so far; an underflow, or a wait for late samples, sets the clock back.
    double played() {
        const double played = (now_s() - header_->t0_s) * clock_hz();
        if (header_->sent == 0) return 0.0;
        const double late_s = (played - double(header_->sent)) / clock_hz();
        const bool forced = header_->fault & UNDERFLOW_ONCE;
        if (late_s <= 0.0 && !forced) return std::max(0.0, played);
        if (forced || late_s > header_->patience_s) {
            header_->underflows++;
            header_->fault &= ~uint64_t(UNDERFLOW_ONCE);
        }
        header_->t0_s = now_s() - double(header_->sent) / clock_hz();
        trace("play", header_->t0_s, clock_hz());
        return double(header_->sent);
    }

    // How many of n samples the buffer takes; waits for all of them as long as it may.
    size_t wait_for_room(const size_t n, const double timeout_s) {
        const double deadline_s = now_s() + timeout_s, size = buffer_s_ * header_->rate_hz;
        for (;;) {
            const bool stalled = header_->fault & STALL;
            const double free = stalled ? 0.0 : size - (double(header_->sent) - played());
            const double left_s = deadline_s - now_s();
            if (free >= double(n)) return n;
            if (left_s <= 0.0) return free >= 1.0 ? size_t(free) : 0;
            const double wait_s = stalled ? 1e-3 : (double(n) - free) / clock_hz();
            std::this_thread::sleep_for(std::chrono::duration<double>(std::min(std::min(wait_s, left_s), 0.05)));
        }
    }

    void keep(const size_t i, const Sample *samples, const size_t n) {
        const size_t channel = channels_[i], start = header_->sent % RING, head = std::min(n, RING - start);
        Sample *ring = ring_ + channel * RING;
        if (header_->fault & (channel == 0 ? MUTE_0 : MUTE_1)) {
            std::memset(ring + start, 0, head * sizeof(Sample));
            std::memset(ring, 0, (n - head) * sizeof(Sample));
        } else {
            std::memcpy(ring + start, samples, head * sizeof(Sample));
            std::memcpy(ring, samples + head, (n - head) * sizeof(Sample));
        }
        if (i < records_.size() && records_[i] && header_->sent < n_record_)
            std::fwrite(samples, sizeof(Sample), std::min(n, size_t(n_record_ - header_->sent)), records_[i]);
    }

    std::string folder_;
    size_t n_channels_;
    double buffer_s_, coerced_hz_, delay_s_, zero_s_ = now_s();
    double time_;
    bool tunes_digitally_;
    size_t n_record_;
    std::string unlocked_;
    int file_ = -1;
    Header *header_ = nullptr;
    Sample *ring_ = nullptr;
    std::vector<size_t> channels_;
    std::vector<std::FILE *> records_;
    std::FILE *trace_ = nullptr;
    uint64_t n_told_[3] = {};
};

SoapySDR::KwargsList find(const SoapySDR::Kwargs &args) {
    if (text(args, "driver", "") != "capture") return {};
    return {args};
}

SoapySDR::Device *make(const SoapySDR::Kwargs &args) {
    if (text(args, "fault", "") == "absent") throw std::runtime_error("no such radio");
    return new Capture(args);
}

SoapySDR::Registry registered("capture", &find, &make, SOAPY_SDR_ABI_VERSION);

}  // namespace
