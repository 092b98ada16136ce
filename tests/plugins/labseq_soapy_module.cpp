// A radio for the real libSoapySDR, to compare with the simulated one: what labseq_soapy_sim/device.py does,
// without its shared memory and faults. The SoapySDR device "capture".
//
// Arguments: folder (of its files), record (above 0: files with the samples and changes of the transmitters),
// channels, buffer (s), components, time, delay (s), unlocked, detune (Hz), fault; as those of the simulated radio.

#include <SoapySDR/Device.hpp>
#include <SoapySDR/Errors.hpp>
#include <SoapySDR/Formats.hpp>
#include <SoapySDR/Registry.hpp>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <fstream>
#include <stdexcept>
#include <thread>

using std::size_t;
using std::string;

namespace {

constexpr size_t CHANNELS = 2, MTU = 16384;
constexpr int REPORTED[] = {SOAPY_SDR_UNDERFLOW, SOAPY_SDR_TIME_ERROR};

double now_s() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

void pause(const double s) { std::this_thread::sleep_for(std::chrono::duration<double>(s)); }

void refuse(const bool is_wrong, const string &why) {
    if (is_wrong) throw std::runtime_error(why);
}

class Capture : public SoapySDR::Device {
public:
    explicit Capture(const SoapySDR::Kwargs &args) : args_(args), n_channels_(size_t(number("channels", CHANNELS))) {
        if (number("record", 0) > 0) trace_.open(text("folder") + "/trace", std::ios::app);
        trace("open");
    }
    ~Capture() override { trace("close"); }

    string getDriverKey() const override { return "capture"; }
    string getHardwareKey() const override { return "capture"; }
    SoapySDR::Kwargs getHardwareInfo() const override { return {{"serial", "simulated"}}; }
    size_t getNumChannels(const int direction) const override { return direction == SOAPY_SDR_TX ? n_channels_ : 0; }

    void setClockSource(const string &source) override {
        refuse(source != "internal" && source != "external", "there is no clock source " + source);
    }
    void setAntenna(const int, const size_t, const string &name) override {
        refuse(name != "TX/RX", "there is no antenna " + name);
    }
    void setSampleRate(const int, const size_t, const double rate) override { rate_hz_ = rate; }
    double getSampleRate(const int, const size_t channel) const override {
        refuse(channel >= n_channels_, "there is no channel " + std::to_string(channel));
        return rate_hz_;
    }

    std::vector<string> listFrequencies(const int, const size_t) const override {
        return number("components", 2) > 1 ? std::vector<string>{"RF", "BB"} : std::vector<string>{"RF"};
    }
    void setFrequency(const int, const size_t channel, const string &name, const double frequency,
                      const SoapySDR::Kwargs &) override {
        if (name == "RF") oscillator_hz_[channel] = std::min(std::max(frequency + number("detune", 0), 1e6), 6e9);
        else shift_hz_[channel] = std::min(std::max(frequency, -100e6), 100e6);
    }
    double getFrequency(const int, const size_t channel, const string &name) const override {
        return name == "RF" ? oscillator_hz_[channel] : shift_hz_[channel];
    }

    std::vector<string> listSensors() const override { return {"ref_locked"}; }
    string readSensor(const string &) const override { return text("unlocked") == "ref" ? "false" : "true"; }
    std::vector<string> listSensors(const int, const size_t) const override { return {"lo_locked"}; }
    string readSensor(const int, const size_t, const string &) const override {
        return text("unlocked") == "lo" ? "false" : "true";
    }
    bool hasHardwareTime(const string &) const override { return number("time", 1) > 0; }
    long long getHardwareTime(const string &) const override { return (long long)(1e9 * (now_s() - zero_s_)); }

    void setGain(const int, const size_t channel, const double gain) override {
        gain_db_[channel] = std::min(std::max(std::nearbyint(gain / 0.25) * 0.25, 0.0), 60.0);
        trace("gain", double(channel), gain_db_[channel]);
    }
    double getGain(const int, const size_t channel) const override { return gain_db_[channel]; }
    SoapySDR::Range getGainRange(const int, const size_t channel) const override {
        refuse(channel >= n_channels_, "there is no channel " + std::to_string(channel));
        return SoapySDR::Range(0.0, 60.0, 0.25);
    }

    SoapySDR::Stream *setupStream(const int, const string &format, const std::vector<size_t> &channels,
                                  const SoapySDR::Kwargs &) override {
        refuse(format != SOAPY_SDR_CF32, "it takes samples as CF32 only");
        for (const size_t channel : channels)
            if (trace_.is_open())
                records_.emplace_back(text("folder") + "/channel" + std::to_string(channel), std::ios::binary);
        return reinterpret_cast<SoapySDR::Stream *>(this);
    }
    void closeStream(SoapySDR::Stream *) override { records_.clear(); }
    int activateStream(SoapySDR::Stream *, const int, const long long, const size_t) override {
        if (text("fault") == "inactive") return SOAPY_SDR_STREAM_ERROR;
        is_active_ = true;
        return 0;
    }
    int deactivateStream(SoapySDR::Stream *, const int, const long long) override {
        is_active_ = false;
        trace("stop");
        return 0;
    }

    int writeStream(SoapySDR::Stream *, const void *const *buffers, const size_t n, int &flags,
                    const long long time_ns, const long timeout_us) override {
        if (!is_active_) return SOAPY_SDR_STREAM_ERROR;
        const bool timed = flags & SOAPY_SDR_HAS_TIME;
        if (timed && number("time", 1) > 1) return SOAPY_SDR_NOT_SUPPORTED;
        if (sent_ == 0) start(timed, zero_s_ + 1e-9 * double(time_ns));
        const size_t room = wait_for_room(std::min(n, MTU), 1e-6 * double(timeout_us));
        if (room == 0) return SOAPY_SDR_TIMEOUT;
        for (size_t i = 0; i < records_.size(); i++)
            records_[i].write(static_cast<const char *>(buffers[i]), std::streamsize(8 * room)).flush();
        sent_ += double(room);
        is_dry_ = false;
        return int(room);
    }

    int readStreamStatus(SoapySDR::Stream *, size_t &, int &, long long &, const long timeout_us) override {
        const double deadline_s = now_s() + 1e-6 * double(timeout_us);
        for (;;) {
            notice_underflow();
            for (size_t i = 0; i < 2; i++)
                if (counts_[i] > 0) return counts_[i]--, REPORTED[i];
            if (now_s() >= deadline_s) return SOAPY_SDR_TIMEOUT;
            pause(1e-3);
        }
    }

private:
    string text(const string &key) const { return args_.count(key) ? args_.at(key) : ""; }
    double number(const string &key, const double otherwise) const {
        return args_.count(key) ? std::stod(args_.at(key)) : otherwise;
    }
    void trace(const string &name, const double first = 0.0, const double second = 0.0) {
        if (trace_.is_open()) trace_ << now_s() << ' ' << name << ' ' << first << ' ' << second << std::endl;
    }
    void start(const bool timed, const double time_s) {
        const bool is_late = timed && time_s <= now_s() + number("delay", 0);
        counts_[1] += is_late;
        t0_s_ = timed && !is_late ? time_s : now_s();
        trace("play");
    }
    double late_s() const { return now_s() - t0_s_ - sent_ / rate_hz_; }
    void notice_underflow() {
        if (!is_active_ || sent_ == 0 || is_dry_ || late_s() <= 0.0) return;
        counts_[0]++;
        is_dry_ = true;
    }
    size_t wait_for_room(const size_t n, const double timeout_s) {
        const double deadline_s = now_s() + timeout_s, size = number("buffer", 0.05) * rate_hz_;
        for (;;) {
            notice_underflow();
            if (is_dry_) t0_s_ = now_s() - sent_ / rate_hz_;
            const double room = size - std::min(sent_, -late_s() * rate_hz_), left_s = deadline_s - now_s();
            if (room >= double(n)) return n;
            if (left_s <= 0.0) return size_t(std::max(room, 0.0));
            pause(std::min((double(n) - room) / rate_hz_, left_s));
        }
    }

    SoapySDR::Kwargs args_;
    size_t n_channels_;
    double rate_hz_ = 0.0, zero_s_ = now_s(), t0_s_ = 0.0, sent_ = 0.0;
    double oscillator_hz_[CHANNELS] = {}, shift_hz_[CHANNELS] = {}, gain_db_[CHANNELS] = {};
    bool is_active_ = false, is_dry_ = false;
    int counts_[2] = {};
    std::ofstream trace_;
    std::vector<std::ofstream> records_;
};

SoapySDR::KwargsList find(const SoapySDR::Kwargs &args) {
    return args.count("driver") && args.at("driver") == "capture" ? SoapySDR::KwargsList{args} : SoapySDR::KwargsList{};
}

SoapySDR::Device *make(const SoapySDR::Kwargs &args) {
    refuse(args.count("fault") && args.at("fault") == "absent", "no such radio");
    return new Capture(args);
}

SoapySDR::Registry registered("capture", &find, &make, SOAPY_SDR_ABI_VERSION);

}  // namespace
